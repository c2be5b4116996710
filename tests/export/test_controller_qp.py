"""The quadratic programs of exported controllers against DAQP's own package, on random programs."""

from __future__ import annotations

import ctypes
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

daqp = pytest.importorskip("daqp", reason="the solver is an optional package")
OPTIMAL, SOFT, INFEASIBLE, LIMIT, SINGULAR, CYCLE = range(6)
NONE = 1e30
ROOM = resources.files("edp.export.controller")
MOST = 40
"""Rows for which there is memory."""
DRIVER = """
#include "edp_qp.h"
static c_float numbers[EDP_QP_NUMBERS(20u, 40u)];
static int integers[EDP_QP_INTEGERS(20u, 40u)];
int solve(uint32_t n, uint32_t rows, uint32_t limit, int soft, double *h, double *f, double *a, double *lower,
          double *upper, double *x, uint32_t *used);
int solve(uint32_t n, uint32_t rows, uint32_t limit, int soft, double *h, double *f, double *a, double *lower,
          double *upper, double *x, uint32_t *used) {
    const edp_qp qp = {n, rows, limit, soft != 0, h, f, a, lower, upper, numbers, integers};
    return (int)edp_qp_solve(&qp, x, used);
}
"""


@pytest.fixture(scope="module")
def library(c, tmp_path_factory):
    """The solver with all warnings on, as a library."""
    c.need("gcc")
    folder = tmp_path_factory.mktemp("qp")
    (folder / "daqp").mkdir()
    for name in ("edp_qp.c", "edp_qp.h"):
        (folder / name).write_bytes((ROOM / "runtime" / name).read_bytes())
    for source in (ROOM / "daqp").iterdir():
        (folder / "daqp" / source.name).write_bytes(source.read_bytes())
    (folder / "driver.c").write_text(DRIVER)
    c.run("gcc", *c.flags, "-O1", "-fPIC", "-c", "edp_qp.c", "driver.c", folder=folder)
    # DAQP's own files convert numbers implicitly.
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-fPIC")
    c.run("gcc", *strict, "-c", *(f"daqp/{name}.c" for name in ("daqp", "auxiliary", "factorization")), folder=folder)
    objects = [f"{name}.o" for name in ("edp_qp", "driver", "daqp", "auxiliary", "factorization")]
    c.run("gcc", "-shared", *objects, "-lm", "-o", "libqp.so", folder=folder)
    return ctypes.CDLL(str(folder / "libqp.so"))


def solved(library, program, soft=False, limit=1000):
    """Status, solution and iterations."""
    hessian, gradient, rows, lower, upper = (np.array(part, float, order="C") for part in program)
    x, used = np.full(len(gradient), np.nan), ctypes.c_uint32()
    parts = [part.ctypes.data_as(ctypes.c_void_p) for part in (hessian, gradient, rows, lower, upper, x)]
    sizes = [ctypes.c_uint32(value) for value in (len(gradient), len(rows), limit)]
    status = library.solve(*sizes, int(soft), *parts, ctypes.byref(used))
    return status, x, used.value


def rival(program, soft=False):
    """Exit flag and solution of the package."""
    hessian, gradient, rows, lower, upper = (np.array(part, float, order="C") for part in program)
    sense = np.zeros(len(lower), np.int32)
    sense[len(gradient) :] = 8 if soft else 0
    x, _, flag, _ = daqp.solve(hessian, gradient, rows, upper, lower, sense)
    return flag, np.asarray(x)


def drawn(seed, variables, rows, width, contradictory=False):
    """A random program; with `contradictory` two rows that exclude each other."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(variables + 3, variables)) * rng.uniform(0.1, 3.0, variables)
    hessian = root.T @ root + 0.01 * np.eye(variables)
    matrix = rng.normal(size=(rows, variables))
    middle = np.concatenate([0.1 * rng.normal(size=variables), rng.normal(size=rows)])
    lower, upper = middle - width * rng.uniform(0.1, 1, len(middle)), middle + width * rng.uniform(0.1, 1, len(middle))
    lower[variables:][rng.random(rows) < 0.3] = -NONE
    if contradictory:
        matrix[1] = -2.0 * matrix[0]
        lower[variables], upper[variables] = 1.0, 2.0
        lower[variables + 1], upper[variables + 1] = 1.0, 2.0
    return hessian, 3.0 * rng.normal(size=variables), matrix, lower, upper


CASES = {
    "seed": st.integers(0, 2**32 - 1),
    "variables": st.integers(1, 20),
    "rows": st.integers(0, MOST),
    "width": st.floats(0.05, 5.0),
}


@given(**CASES)
@settings(max_examples=120, deadline=None)
def test_hard_programs_have_the_solution_of_the_package_or_both_have_none(library, seed, variables, rows, width):
    program = drawn(seed, variables, rows, width)
    status, x, used = solved(library, program)
    flag, expected = rival(program)
    assert (status == OPTIMAL) == (flag == 1), (status, flag)
    if flag == 1:
        assert x == pytest.approx(expected, abs=1e-6)
        assert used < 1000
    else:
        assert status == INFEASIBLE
        assert np.isnan(x).all()


@given(**CASES)
@settings(max_examples=120, deadline=None)
def test_soft_programs_always_have_the_solution_of_the_package(library, seed, variables, rows, width):
    program = drawn(seed, variables, rows, width)
    status, x, _ = solved(library, program, soft=True)
    flag, expected = rival(program, soft=True)
    assert {OPTIMAL: 1, SOFT: 2}[status] == flag
    assert x == pytest.approx(expected, abs=1e-5, rel=1e-5)


@given(seed=st.integers(0, 2**32 - 1), variables=st.integers(2, 20), rows=st.integers(2, MOST))
@settings(max_examples=60, deadline=None)
def test_rows_that_exclude_each_other_are_infeasible_or_give_way(library, seed, variables, rows):
    program = drawn(seed, variables, rows, 2.0, contradictory=True)
    assert solved(library, program)[0] == INFEASIBLE
    assert rival(program)[0] == -1
    assert solved(library, program, soft=True)[0] == SOFT


@given(seed=st.integers(0, 2**32 - 1), variables=st.integers(1, 20), rows=st.integers(1, MOST))
@settings(max_examples=100, deadline=None)
def test_a_solution_fulfils_the_conditions_of_a_minimum(library, seed, variables, rows):
    hessian, gradient, matrix, lower, upper = program = drawn(seed, variables, rows, 3.0)
    status, x, _ = solved(library, program)
    if status != OPTIMAL:
        return
    every = np.concatenate([x, matrix @ x])
    assert (every <= upper + 2e-6).all()
    assert (every >= lower - 2e-6).all()
    # The slope of the cost is a positive sum of the normals of the bounds that act.
    normals = np.vstack([np.eye(variables), matrix])
    high, low = every > upper - 1e-5, every < lower + 1e-5
    acting = np.vstack([-normals[high], normals[low]])
    from scipy.optimize import nnls

    slope = hessian @ x + gradient
    rest = np.linalg.norm(slope) if not len(acting) else nnls(acting.T, slope)[1]
    assert rest < 1e-4 * (1.0 + np.abs(gradient).max())


def test_an_iteration_limit_is_kept_and_told(library):
    program = drawn(5, 18, 30, 0.5)
    status, x, used = solved(library, program, limit=3)
    assert (status, used) == (LIMIT, 3)
    assert np.isnan(x).all()
    assert solved(library, program)[0] in (OPTIMAL, INFEASIBLE)


@pytest.mark.parametrize("part", range(5))
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(library, part, value):
    program = [np.array(values) for values in drawn(1, 6, 4, 2.0)]
    program[part].flat[1] = value
    status, x, _ = solved(library, program)
    assert status == SINGULAR
    assert np.isnan(x).all()


def test_a_flat_direction_is_refused(library):
    program = (np.diag([1.0, 0.0]), np.ones(2), np.zeros((0, 2)), -np.ones(2), np.ones(2))
    assert solved(library, program)[0] == SINGULAR


def test_rows_without_variables_hold_or_do_not(library):
    bounds = np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 2.0])
    program = (np.eye(2), np.array([0.3, -0.4]), np.zeros((1, 2)), *bounds)
    assert solved(library, program)[0] == INFEASIBLE
    status, x, _ = solved(library, program, soft=True)
    assert status == OPTIMAL
    assert x == pytest.approx([-0.3, 0.4])


def test_bounds_that_meet_fix_a_variable(library):
    program = (np.eye(2), np.array([1.0, 1.0]), np.zeros((0, 2)), np.array([0.2, -9.0]), np.array([0.2, 9.0]))
    status, x, _ = solved(library, program)
    assert status == OPTIMAL
    assert x == pytest.approx([0.2, -1.0])
