"""Machine code of a grey box: every derivative that it gives, against differences of its own values."""

import ctypes

import numpy as np
import pytest
from grey_front import front, front_channels, series_of

from edp.networks.twin import fit_scales
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey import program as code


@pytest.fixture(scope="module")
def twin():
    channels, series = front_channels(), [series_of()]
    return front().start(channels, fit_scales(channels, series), series, 0)


@pytest.fixture(scope="module")
def polynomials():
    channels, series = front_channels(), [series_of()]
    return front(linkage="").start(channels, fit_scales(channels, series), series, 0)


def functions(twin, seed=0):
    """Parameters, inputs of a plausible state, and a call of each function."""
    program, rng = twin.program, np.random.default_rng(seed)
    sizes = program.sizes
    n, valves, nodes, frame = sizes.actuators, sizes.valves, sizes.nodes, program.frame
    table = twin.table
    drawn = rng.normal(0.0, 0.1, len(table.nominal))
    numbers = np.where(table.positive, table.nominal * np.exp(drawn), table.nominal + table.width * drawn)
    machine, inputs = twin.machine(numbers), rng.uniform(0.1, 0.9, frame.size)
    inputs[:nodes], inputs[nodes : nodes + n] = rng.uniform(2.0, 20.0, nodes), rng.uniform(-0.3, 0.3, n)
    inputs[frame.bristle_base : frame.bristle_base + n] = rng.uniform(-1e-4, 1e-4, n)
    inputs[frame.valves : frame.delayed_commands] = rng.uniform(-0.8, 0.8, valves * at.VALVE_STATES)
    inputs[frame.step], inputs[frame.half], inputs[frame.length] = 0.003, 0.0015, 0.004

    def call(which, numbers=numbers, inputs=inputs):
        out = np.zeros(program.results)
        made = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)(int(program.addresses[which]))
        made(*(part.ctypes.data for part in (np.ascontiguousarray(numbers), machine.constants, inputs, out)))
        return out

    return numbers, inputs, call


def check_group(twin, group, which, variables):
    """A group of derivatives against differences; `variables`: which input or parameter a column is."""
    numbers, inputs, call = functions(twin)
    first, begin, end = twin.program.groups[group]
    entries, told = twin.program.entries[begin:end], call(which)[first : first + end - begin]
    for column in np.unique(entries[:, 1]):
        kind, place = variables(column)
        values = {"numbers": numbers, "inputs": inputs}[kind]
        size = 1e-6 * max(abs(values[place]), 1e-3)
        sides = []
        for side in (size, -size):
            moved = values.copy()
            moved[place] += side
            sides.append(call(which, **{kind: moved}))
        expected = (sides[0] - sides[1]) / (2.0 * size)
        mine = np.flatnonzero(entries[:, 1] == column)
        np.testing.assert_allclose(told[mine], expected[entries[mine, 0]], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("group", "which"),
    [
        (code.CONTENT_PARAMETERS, code.CONTENTS),
        (code.BRISTLE_PARAMETERS, code.BRISTLES),
        (code.PUMP_PARAMETERS, code.PUMPS),
    ],
)
def test_derivatives_by_parameters_are_those_of_differences(twin, group, which):
    check_group(twin, group, which, lambda column: ("numbers", column))


def test_derivatives_of_valves_and_pumps_by_states_are_those_of_differences(twin):
    frame, states = twin.program.frame, twin.program.sizes.valves * at.VALVE_STATES
    check_group(twin, code.VALVE_STATES, code.VALVES, lambda column: ("inputs", frame.valves + column))
    check_group(twin, code.PUMP_FRAME, code.PUMPS, lambda column: ("inputs", column))
    pilots = frame.valves + at.PILOT_2
    check_group(twin, code.PUMP_PILOTS, code.PUMPS, lambda j: ("inputs", pilots + at.VALVE_STATES * j))
    assert frame.delayed_commands - frame.valves == states


def test_a_step_of_newton_solves_the_linear_equations_of_residual_and_matrix(twin):
    _, _, call = functions(twin)
    size = twin.program.sizes.nodes + twin.program.sizes.actuators
    matrix = call(code.MATRIX)[: size * size].reshape(size, size)
    np.testing.assert_allclose(matrix @ call(code.NEWTON)[:size], call(code.RESIDUAL)[:size], rtol=1e-9, atol=1e-12)


def test_the_matrix_is_that_of_differences(twin):
    _, inputs, call = functions(twin)
    size = twin.program.sizes.nodes + twin.program.sizes.actuators
    matrix = call(code.MATRIX)[: size * size].reshape(size, size)
    for k in range(size):
        step = 1e-6 * np.eye(len(inputs))[k]
        above, below = (call(code.RESIDUAL, inputs=inputs + side * step)[:size] for side in (1.0, -1.0))
        np.testing.assert_allclose(matrix[:, k], (above - below) / 2e-6, rtol=1e-4, atol=1e-6)


def test_forces_of_a_polynomial_load_are_those_of_lagrange(polynomials):
    """Coriolis forces by differences of the inertia: c_i = sum (dM_ij/ds_k - dM_jk/ds_i / 2) v_j v_k."""
    _, inputs, call = functions(polynomials)
    n, frame = polynomials.program.sizes.actuators, polynomials.program.frame
    strokes, speeds = inputs[frame.frozen : frame.frozen + n].copy(), inputs[frame.speeds : frame.speeds + n].copy()

    def load(strokes, speeds):
        moved = inputs.copy()
        moved[frame.frozen : frame.frozen + n], moved[frame.speeds : frame.speeds + n] = strokes, speeds
        out = call(code.LOAD, inputs=moved)
        return out[: n * n].reshape(n, n), out[n * n : n * n + n]

    mass, _ = load(strokes, speeds)
    np.testing.assert_allclose(mass, mass.T, rtol=1e-12)
    assert (np.linalg.eigvalsh(mass) > 0.0).all()
    slopes = np.array([
        (load(strokes + step, speeds)[0] - load(strokes - step, speeds)[0]) / 2e-6 for step in 1e-6 * np.eye(n)
    ])  # fmt: skip
    turning = np.einsum("kij,j,k->i", slopes, speeds, speeds) - 0.5 * np.einsum("ijk,j,k->i", slopes, speeds, speeds)
    told = load(strokes, speeds)[1] - load(strokes, np.zeros(n))[1]
    np.testing.assert_allclose(told, turning, rtol=1e-5, atol=1e-8)
