"""A folder holds the recordings of one order; numbers beyond all use are one message."""

import json
import os
import subprocess
import sys

import pytest

from edp.errors import BusyError, ConfigError, EdpError, StorageError
from edp.jobs import IN_PROCESS
from edp.sim import data_set as data_sets
from edp.sim.data_set import LOCK, MANIFEST, SimulationOrder, simulate_data_set
from edp.sim.predictability import LimitSpec
from edp.sim.scenario import Scenario
from edp.storage import hold

SHORT = {"minutes": 0.02, "recordings": 2}


def recording_of(scenario):
    from edp.sim.simulate import simulate

    return simulate(Scenario(duration_s=0.5, name=scenario.name))


@pytest.fixture
def quick(monkeypatch):
    """Simulating takes no time: what is claimed here is the folder."""

    monkeypatch.setattr(data_sets, "simulate", recording_of)


def test_a_second_order_is_refused_while_the_first_one_runs(tmp_path, quick):
    seen = []

    def on_done(recording, kept):
        with pytest.raises(BusyError, match=f"process {os.getpid()} on .* simulates into"):
            simulate_data_set(tmp_path, SimulationOrder(seed=2, **SHORT), IN_PROCESS)
        seen.append(recording.name)

    made = simulate_data_set(tmp_path, SimulationOrder(seed=1, **SHORT), IN_PROCESS, on_done)
    assert len(seen) == 2
    assert sorted(os.listdir(tmp_path)) == sorted([MANIFEST, *(path.name for path in made)])
    with pytest.raises(StorageError, match="holds another simulated data set"):
        simulate_data_set(tmp_path, SimulationOrder(seed=2, **SHORT), IN_PROCESS)
    with pytest.raises(StorageError, match="holds another simulated data set"):
        simulate_data_set(tmp_path, SimulationOrder(seed=1, suffix=".csv", **SHORT), IN_PROCESS)


def test_the_manifest_is_read_after_the_folder_is_held(tmp_path, quick, monkeypatch):
    """Both saw an empty folder: the second one must see the first one's order once it may go on."""
    first, second = SimulationOrder(seed=1, **SHORT), SimulationOrder(seed=2, **SHORT)
    real = data_sets.hold

    def after_the_other(path):
        monkeypatch.setattr(data_sets, "hold", real)
        simulate_data_set(tmp_path, first, IN_PROCESS)
        return real(path)

    monkeypatch.setattr(data_sets, "hold", after_the_other)
    with pytest.raises(StorageError, match="holds another simulated data set"):
        simulate_data_set(tmp_path, second, IN_PROCESS)
    assert len(list(tmp_path.glob("*.parquet"))) == 2


def test_a_stopped_data_set_goes_on_and_leftovers_go(tmp_path, quick):
    order = SimulationOrder(seed=1, **SHORT)

    def stop(recording, kept):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_data_set(tmp_path, order, IN_PROCESS, stop)
    (tmp_path / ".x.parquet.0123456789ab.tmp").write_bytes(b"half")
    kept = []
    simulate_data_set(tmp_path, order, IN_PROCESS, lambda recording, was: kept.append(was))
    assert kept == [True, False]
    assert not list(tmp_path.glob(".*"))


def test_a_lock_that_was_removed_ends_it(tmp_path, quick):
    def remove(recording, kept):
        (tmp_path / LOCK).unlink()

    with pytest.raises(StorageError, match="removed or replaced"):
        simulate_data_set(tmp_path, SimulationOrder(seed=1, **SHORT), IN_PROCESS, remove)
    assert len(list(tmp_path.glob("*.parquet"))) == 1


@pytest.mark.parametrize("content", ["null", "[", "[" * 100_000, '{"schema": 1}'])
def test_a_hostile_manifest_is_one_message(tmp_path, content):
    (tmp_path / MANIFEST).write_text(content)
    with pytest.raises(StorageError, match=r"data_set\.json|holds another"):
        simulate_data_set(tmp_path, SimulationOrder(**SHORT), IN_PROCESS)
    assert sorted(os.listdir(tmp_path)) == [MANIFEST]


@pytest.mark.parametrize(
    "values",
    [
        {"seed": -1},
        {"seed": 10**26},
        {"recordings": 10**9},
        {"recordings": -1},
        {"family": 10**9},
        {"minutes": 1e300},
        {"minutes": float("nan")},
        {"minutes": float("inf")},
    ],
    ids=str,
)
def test_numbers_beyond_all_use_are_one_message(values):
    with pytest.raises(ConfigError, match=next(iter(values))):
        SimulationOrder.from_scenario(**values)


@pytest.mark.parametrize(
    "values", [{"branches": 10**9}, {"branches": -2}, {"moments": 10**9}, {"moments": -1}], ids=str
)
def test_a_limit_beyond_all_use_is_one_message(values):
    with pytest.raises(EdpError, match=next(iter(values))):
        LimitSpec(**values)


@pytest.mark.slow
def test_two_commands_at_once_leave_one_data_set(tmp_path):
    command = [sys.executable, "-m", "edp", "simulate", str(tmp_path / "data"), "--minutes", "4", "--recordings", "4"]
    for _ in range(2):
        both = [
            subprocess.Popen([*command, "--workers", "1", "--seed", seed], stderr=subprocess.PIPE, text=True)
            for seed in ("1", "2")
        ]
        said = [one.communicate()[1] for one in both]
        codes = [one.returncode for one in both]
        assert "Traceback" not in "".join(said)
        assert sorted(codes)[0] == 0
        assert sorted(codes)[1] in (1, 75)
        winner = ("1", "2")[codes.index(0)]
        plan = json.loads((tmp_path / "data" / MANIFEST).read_text())["plan"]
        asked = SimulationOrder(minutes=4, recordings=4, seed=int(winner)).scenarios()
        assert [entry["seed"] for entry in plan] == [scenario.seed for scenario in asked]
        assert len(list((tmp_path / "data").glob("*.parquet"))) == 4
        for file in (tmp_path / "data").iterdir():
            file.unlink()


def test_who_holds_the_folder_is_told_by_the_command(tmp_path, capsys, monkeypatch):
    from edp.cli import app
    from edp.cli.console import run_app

    lock = hold(tmp_path / LOCK)
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setattr(sys, "argv", ["edp", "simulate", str(tmp_path), "--minutes", "1", "--recordings", "2"])
    assert run_app(app) == 75
    assert "simulates into" in capsys.readouterr().err
    lock.close()
