"""Result files that somebody changed: a value of another kind is one message, whatever the file and the value."""

import dataclasses
import importlib
import pkgutil

import pytest

import edp.control
import edp.evaluation
import edp.monitor
import edp.report
import edp.sim
from edp.errors import StorageError
from edp.settings.results import ResultFile
from edp.storage import write_json
from edp.storage.headers import check_files

ODD = (None, "", "text", -1, 0.5, 10**30, True, [], [[]], [None], {}, {"a": 1}, {"a": {"b": []}})


def result_files():
    """Every class of result files."""
    for package in (edp.control, edp.evaluation, edp.monitor, edp.report, edp.sim):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(found.name)
    return sorted(ResultFile.__subclasses__(), key=lambda kind: kind.__name__)


CLASSES = result_files()


def test_the_result_files_are_found():
    assert {"AdaptationFile", "ControlFile", "LimitFile", "MonitorRunFile", "ScoresFile", "TuningFile"} <= {
        c.__name__ for c in CLASSES
    }
    assert all(dataclasses.is_dataclass(kind) for kind in CLASSES)


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_a_value_of_another_kind_is_one_message(kind, tmp_path):
    messages = []
    for name in [entry.name for entry in dataclasses.fields(kind)] + ["no_such_key", "schema"]:
        for value in ODD:
            write_json(tmp_path / kind.NAME, {"schema": kind.SCHEMA, name: value} if kind.SCHEMA else {name: value})
            try:
                kind.read(tmp_path)
            except StorageError as error:
                messages.append(str(error))
    assert len(messages) > len(ODD)
    assert all(kind.NAME in message and kind.ADVICE in message for message in messages)


def test_hashes_of_another_kind_are_refused(tmp_path):
    for value in ODD:
        if not isinstance(value, dict):
            with pytest.raises(StorageError, match="as hashes of files, expected a table by name; again"):
                check_files(value, tmp_path, "again")
