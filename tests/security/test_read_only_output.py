"""Commands that compute for minutes say first that their folder cannot be written."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import edp.storage.writing
import edp.workflows.train_evaluate
from edp.errors import EdpError, StorageError
from edp.logs.source import DataSource
from edp.workflows.compression.quantise import quantise
from edp.workflows.feature_selection.select import select_features


def full(target: Path) -> tuple[int, str]:
    raise OSError(30, "Read-only file system")


@pytest.mark.parametrize("command", ["evaluate", "channel_importance"])
def test_a_run_that_cannot_be_written_is_told_before_it_is_read(command, tmp_path, monkeypatch):
    monkeypatch.setattr(edp.storage.writing, "_temporary", full)
    monkeypatch.setattr(
        edp.workflows.train_evaluate, "read_trained_run", lambda folder: pytest.fail("it was read first")
    )
    with pytest.raises(StorageError, match="Read-only file system"):
        getattr(edp.workflows.train_evaluate, command)(tmp_path)


def test_a_run_in_integers_that_cannot_be_written_is_told_before_it_is_computed(tmp_path, monkeypatch):
    module, bundle = (
        sys.modules[quantise.__module__],
        SimpleNamespace(predictor=SimpleNamespace(number_format="float32")),
    )
    monkeypatch.setattr(module, "read_trained_run", lambda folder: (bundle, None, {}, None))
    monkeypatch.setattr(module, "integer_predictor", lambda *_: pytest.fail("it was computed first"))
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot create folder"):
        quantise(tmp_path / "run", tmp_path / "file")
    monkeypatch.setattr(edp.storage.writing, "_temporary", full)
    with pytest.raises(StorageError, match="Read-only file system"):
        quantise(tmp_path / "run", tmp_path / "out")


def test_a_missing_run_is_not_made(tmp_path):
    with pytest.raises(EdpError, match="run"):
        edp.workflows.train_evaluate.evaluate(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_screening_that_cannot_be_written_reads_no_log(tmp_path, monkeypatch):
    monkeypatch.setattr(edp.storage.writing, "_temporary", full)
    with pytest.raises(StorageError, match="Read-only file system"):
        select_features(DataSource.from_path(tmp_path / "no_logs"), tmp_path / "screen")
