"""What `edp runs` calls a run before and after its result is there, and progress beyond a plan."""

import contextlib

import pytest

from edp.cli.console import Steps, progress
from edp.cli.progress import Display, StageDisplay
from edp.errors import StorageError
from edp.storage import write_json
from edp.storage.locks import hold
from edp.storage.run_kinds import RUN_KINDS
from edp.storage.run_listing import MODELS, list_runs
from edp.storage.runs import Run, state_of
from edp.training.fitted_twin import FreeRunProgress
from edp.training.progress_steps import free_run_steps


@pytest.mark.parametrize("kind", sorted(set(RUN_KINDS) - {"search"}))
def test_a_run_is_listed_by_its_kind_and_state(tmp_path, kind):
    def listed():
        (row,) = list_runs(tmp_path)[0]
        return row.kind, row.state

    model = RUN_KINDS[kind].model
    with contextlib.suppress(KeyboardInterrupt), Run.create(tmp_path / "run", kind, "0" * 32):
        raise KeyboardInterrupt
    assert listed() == (kind, "stopped")
    with Run.create(tmp_path / "run", kind, "0" * 32):
        assert listed() == (kind, "running")
    assert listed() == (kind, "damaged" if model in MODELS else "finished")
    with Run.create(tmp_path / "run", kind, "0" * 32) as run:
        assert run.is_finished
    with pytest.raises(StorageError, match="another run"), Run.create(tmp_path / "run", kind, "1" * 32):
        pass


def test_a_training_within_a_run_leaves_the_end_to_the_run(tmp_path):
    with Run(tmp_path / "run", "transfer") as whole:
        with Run.create(whole, "network", "0" * 32):
            pass
        assert state_of(tmp_path / "run") == "running"
        whole.finish()
    (row,) = list_runs(tmp_path)[0]
    assert (row.kind, state_of(tmp_path / "run")) == ("transfer", "finished")


@pytest.mark.parametrize(
    ("state", "listed"), [("running", "stopped"), ("stopped", "stopped"), ("finished", "finished")]
)
def test_a_search_is_listed_with_the_state_of_its_study(tmp_path, state, listed):
    write_json(tmp_path / "study.json", {"schema": 2, "state": state, "mode": "sound"})
    assert list_runs(tmp_path)[0][0].state == ("finished" if state == "finished" else "stopped")
    (tmp_path / "ledger").mkdir()
    lock = hold(tmp_path / "ledger" / ".lock")
    assert list_runs(tmp_path)[0][0].state == "running"
    lock.close()


def test_a_kind_that_no_run_has_is_not_listed(tmp_path):
    with Run(tmp_path / "run") as folder:
        folder.write_status("running", kind="\x1b[2J")
    assert list_runs(tmp_path)[0][0].kind == "network"


@pytest.mark.parametrize(("mark", "kind"), [("compression.json", "compression"), ("alarms.jsonl", "monitor run")])
def test_results_of_earlier_versions_are_listed_as_finished(tmp_path, mark, kind):
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / mark).write_text("{}")
    (row,) = list_runs(tmp_path)[0]
    assert (row.kind, row.state) == (kind, "finished")


def test_a_fit_that_exceeds_its_plan_says_so(capsys):
    with progress(quiet=False) as shown:
        whole = StageDisplay(Display(shown, Steps(False, every_s=0.0), "twin"))
        for update in (64, 88):
            free_run_steps(whole)(FreeRunProgress(update, 64, 1.0, 0.2, None, False))
        assert shown.tasks[0].completed <= shown.tasks[0].total
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["twin: update 64/64, runs of 1 s", "twin: update 88, more than the 64 planned, runs of 1 s"]
