"""Units of work: equal ones once, killed ones again, failed ones by name, and results in a form that runs nothing."""

import math
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.errors import ConfigError, DataError, LostError
from edp.jobs import IN_PROCESS, LocalPool, Workers
from edp.jobs.packing import classes_in, pack, unpack
from edp.jobs.workers import UnitError, WorkUnit, forget_units
from edp.signals import Channel, Kind


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


def results_of(units, workers, folder=None):
    return [(one.values, one.content) for one in workers.map_in_order(units, folder=folder)]


def test_equal_units_are_done_once_and_results_come_in_order(units_of, tmp_path):
    told = NotedProgress()
    units = units_of(3, 2, 3)
    results = list(IN_PROCESS.map_in_order(units, told, tmp_path / "kept"))
    assert [result.values["square"] for result in results] == [9, 4, 9]
    assert [result.content for result in results] == [b"3", b"2", b"3"]
    assert starts(tmp_path) == ["3", "2"]
    assert told.notes == ["number 3", "number 2"]
    assert told.steps == [1, 2, 3]


def test_without_a_folder_each_unit_ends_before_the_next_begins(units_of, tmp_path):
    ends = IN_PROCESS.map(units_of(1, 2))
    assert next(ends)[1].content == b"1"
    assert starts(tmp_path) == ["1"]


@pytest.mark.processes
def test_what_is_done_stays_done_and_what_failed_is_tried_again_with_the_same_error(units_of, tmp_path):
    for count in (1, 2):
        kept = tmp_path / f"kept{count}"
        # Of two units that run together, the one that fails may end the other one before its result is stored.
        results_of(units_of(1, refused=2), Workers(count=count), kept)
        for _ in range(2):
            with pytest.raises(DataError, match=r"^a log of row 7 is no log$"):
                results_of(units_of(1, 2, refused=2), Workers(count=count), kept)
        forget_units(kept)
        assert not kept.exists()
    assert starts(tmp_path).count("2") == 4
    assert starts(tmp_path).count("1") == 2


@pytest.mark.processes
def test_another_kind_of_error_in_another_process_names_its_unit(units_of):
    with pytest.raises(UnitError, match=r"^number 2: KeyError"):
        results_of(units_of(1, 2, broken=2), Workers(count=2))


@pytest.mark.processes
def test_a_process_that_dies_each_time_is_one_error_and_the_rest_stays(units_of, tmp_path):
    with pytest.raises(LostError, match=r"number 2: its process ended 3 times.*the same command again"):
        results_of(units_of(1, 2, dies=2), Workers(count=2), tmp_path / "kept")
    assert results_of(units_of(1, dies=2), IN_PROCESS, tmp_path / "kept") == [({"square": 1}, b"1")]
    assert starts(tmp_path).count("1") == 1


@pytest.mark.processes
def test_a_pool_gives_what_this_process_gives_also_where_a_worker_is_killed(units_of, tmp_path):
    looks = []
    together = list(Workers(count=2).map_in_order(units_of(1, 2, 3, killed=2), waiting=lambda: looks.append(1)))
    assert starts(tmp_path).count("2") == 2  # the killed one again, the others once
    assert len(starts(tmp_path)) == 4
    assert [(one.values, one.content) for one in together] == results_of(units_of(1, 2, 3, killed=2), IN_PROCESS)
    with Workers(count=2).stay() as staying:
        results_of(units_of(1, 2), staying)
        before = set(staying.executor.processes())
        results_of(units_of(4, 5), staying)
        assert set(staying.executor.processes()) == before


def test_the_executor_follows_from_what_was_asked_for():
    assert Workers().are_alone
    with Workers(count=3).open() as pool:
        assert isinstance(pool, LocalPool)
        assert pool.workers == 3
    with pytest.raises(ConfigError, match="expected one of the two"):
        Workers(count=2, cluster="auto")


def test_enums_come_back_as_themselves():
    channel = Channel("u", Kind.RATIO, "")
    assert unpack(pack(channel), Channel).kind is Kind.RATIO


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
    found = unpack(pack(value), Outer)
    assert found.parts == value.parts
    assert found.where == value.where
    assert found.table == value.table
    np.testing.assert_array_equal(found.values, value.values)
    assert set(classes_in(Outer)) == {"Outer", "Inner"}
    assert math.isnan(unpack(pack(Inner("a", math.nan)), Inner).number)


@pytest.mark.parametrize("data", [b"", b"x" * 40, pickle.dumps(Inner("a", 1.0))], ids=["empty", "noise", "pickle"])
def test_bytes_that_are_no_result_are_one_message(data):
    with pytest.raises(DataError, match="result of a unit of work is damaged"):
        unpack(data, Inner)


def test_only_named_classes_are_built():
    with pytest.raises(DataError, match="damaged"):
        unpack(pack(Outer((), np.zeros(1), {}, Path("."))), Inner)
    with pytest.raises(TypeError, match="cannot be packed"):
        pack(Inner("a", object()))
