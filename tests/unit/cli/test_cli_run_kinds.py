"""What `edp runs` calls a run before and after its result is there, and progress beyond a plan."""

import pytest

from edp.cli.console import progress
from edp.cli.twin import FitDisplay
from edp.storage.run_listing import list_runs
from edp.storage.runs import RunFolder
from edp.training.free_run import FreeRunProgress


@pytest.mark.parametrize("kind", ["twin", "control", "tuning"])
def test_a_run_at_work_is_listed_by_its_kind(tmp_path, kind):
    with RunFolder(tmp_path / "run") as folder:
        folder.claim("0" * 32, "")
        folder.write_status("running", kind=kind)
        (row,) = list_runs(tmp_path)[0]
    assert (row.kind, row.state) == (kind, "running")


def test_a_kind_that_no_run_has_is_not_listed(tmp_path):
    with RunFolder(tmp_path / "run") as folder:
        folder.claim("0" * 32, "")
        folder.write_status("running", kind="\x1b[2J")
    assert list_runs(tmp_path)[0][0].kind == "network"


@pytest.mark.parametrize(("mark", "kind"), [("compression.json", "compression"), ("alarms.jsonl", "monitor run")])
def test_finished_results_are_no_stopped_networks(tmp_path, mark, kind):
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / mark).write_text("{}")
    (row,) = list_runs(tmp_path)[0]
    assert (row.kind, row.state) == (kind, "finished")


def test_a_fit_that_exceeds_its_plan_says_so(capsys):
    with progress(quiet=False) as shown:
        display = FitDisplay(shown, quiet=False)
        display.steps.every_s = 0.0
        for update in (64, 88):
            display.on_event(FreeRunProgress(update, 64, 1.0, 0.0, None, False))
        assert shown.tasks[0].completed <= shown.tasks[0].total
    assert "88/64" not in capsys.readouterr().err
