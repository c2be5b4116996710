"""Units of work: equal ones once, killed ones again, failed ones by name, and results in a form that runs nothing."""

import math
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.jobs import EXECUTORS, InProcess, LocalPool, Workforce
from edp.jobs.packing import classes_in, packed, unpacked
from edp.jobs.units import UnitError, WorkUnit, forget_units, run_units


@pytest.fixture
def units_of(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)

    def make(*numbers, **arguments):
        where = {"log": str(tmp_path / "log")}
        return [
            WorkUnit("units_of_tests:square", f"number {n}", {"number": n, **arguments}, where=where) for n in numbers
        ]

    return make


def starts(tmp_path):
    return (tmp_path / "log").read_text().split()


def test_equal_units_are_done_once_and_results_come_in_order(units_of, here, tmp_path):
    told = []
    results = run_units(units_of(3, 2, 3), here, on_done=lambda unit, result, done: told.append((unit.label, done)))
    assert [result.values["square"] for result in results] == [9, 4, 9]
    assert [result.content for result in results] == [b"3", b"2", b"3"]
    assert starts(tmp_path) == ["3", "2"]
    assert told == [("number 3", 1), ("number 2", 2)]


def test_what_is_done_stays_done_and_what_failed_is_tried_again(units_of, here, tmp_path):
    with pytest.raises(UnitError, match="number 2: a log of row 7 is no log"):
        run_units(units_of(1, 2, refused=2), here, tmp_path / "kept")
    with pytest.raises(UnitError, match="row 7"):
        run_units(units_of(1, 2, refused=2), here, tmp_path / "kept")
    assert starts(tmp_path) == ["1", "2", "2"]
    forget_units(tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


@pytest.mark.processes
def test_a_pool_gives_what_this_process_gives_also_where_a_worker_is_killed(units_of, here, tmp_path):
    together = run_units(units_of(1, 2, 3, killed=2), Workforce(workers=2))
    assert starts(tmp_path).count("2") == 2  # the killed one again, the others once
    assert len(starts(tmp_path)) == 4
    alone = run_units(units_of(1, 2, 3, killed=2), here)
    assert [(one.values, one.content) for one in together] == [(one.values, one.content) for one in alone]


def test_the_executor_follows_from_what_was_asked_for():
    assert set(EXECUTORS) == {"ray", "local", "processes"}
    assert Workforce().alone
    with Workforce().open() as alone, Workforce(workers=3).open() as pool:
        assert isinstance(alone, InProcess)
        assert isinstance(pool, LocalPool)
        assert pool.workers == 3
    with pytest.raises(ConfigError, match="give one of the two"):
        Workforce(workers=2, cluster="auto")


@dataclass(frozen=True)
class Inner:
    name: str
    number: float | None


@dataclass(frozen=True)
class Outer:
    parts: tuple[Inner, ...]
    values: np.ndarray
    table: dict[int, float]
    where: Path


def test_dataclasses_with_arrays_come_back_to_the_bit():
    value = Outer((Inner("a", math.inf), Inner("b", None)), np.arange(6.0).reshape(2, 3), {3: 0.1}, Path("x/y"))
    found = unpacked(packed(value), Outer)
    assert found.parts == value.parts
    assert found.where == value.where
    assert found.table == value.table
    np.testing.assert_array_equal(found.values, value.values)
    assert set(classes_in(Outer)) == {"Outer", "Inner"}
    assert math.isnan(unpacked(packed(Inner("a", math.nan)), Inner).number)


@pytest.mark.parametrize("data", [b"", b"x" * 40, pickle.dumps(Inner("a", 1.0))], ids=["empty", "noise", "pickle"])
def test_bytes_that_are_no_result_are_one_message(data):
    with pytest.raises(DataError, match="result of a unit of work is damaged"):
        unpacked(data, Inner)


def test_only_named_classes_are_built():
    with pytest.raises(DataError, match="damaged"):
        unpacked(packed(Outer((), np.zeros(1), {}, Path("."))), Inner)
    with pytest.raises(TypeError, match="cannot be packed"):
        packed(Inner("a", object()))
