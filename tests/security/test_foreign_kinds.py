"""Commands write into no folder of another kind, and refuse what cannot be before they compute."""

from __future__ import annotations

import pytest

from edp.errors import ConfigError, StorageError
from edp.evaluation.judge import JudgeSpec
from edp.export.folder import write_export
from edp.storage.folders import MARKS, check_kind, kind_of
from edp.storage.runs import Run
from edp.workflows.auto.settings import Portfolio
from edp.workflows.fleet.registry import add_to_registry
from edp.workflows.monitor import fit_monitor

WRITERS = {
    "run": Run,
    "registry": lambda folder: add_to_registry(folder, folder, "name"),
    "export": lambda folder: write_export(folder, {"a.h": b""}),
    "monitor": lambda folder: fit_monitor([], None, None, folder),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("mark", MARKS)
def test_a_folder_of_another_kind_is_refused_and_stays(writer, mark, tmp_path):
    if MARKS[mark] == writer:
        pytest.skip("its own kind")
    (tmp_path / mark).write_text('{"kind": "twin"}')
    assert kind_of(tmp_path) == MARKS[mark]
    with pytest.raises(StorageError, match="nothing was changed"):
        WRITERS[writer](tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [mark]


def test_empty_absent_and_foreign_folders_have_no_kind(tmp_path):
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "notes.txt").write_text("")
    for folder in (tmp_path / "absent", tmp_path / "foreign"):
        assert kind_of(folder) is None
        check_kind(folder, what="a test")


@pytest.mark.parametrize("minutes", [0.0, -1.0, 1e-320, 1e308, float("nan"), float("inf"), 10**18])
def test_minutes_that_train_nothing_are_refused(minutes):
    with pytest.raises(ConfigError, match="time_budget_min"):
        Portfolio(time_budget_min=minutes)


def test_a_skip_beyond_any_window_is_refused():
    with pytest.raises(ConfigError, match="evaluation: warmup_samples"):
        JudgeSpec(warmup_samples=10**9)
