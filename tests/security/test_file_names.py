"""Logs whose file names are not UTF-8: read like any other, named with escapes, and no hindrance to their folder."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from edp.cli import app
from edp.errors import DataError
from edp.logs import FORMATS, read_data_set, read_recording, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1


def odd(folder: Path, suffix: str) -> Path:
    values = np.arange(200, dtype=np.float32).reshape(100, 2)
    recording = Recording("R", (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"]), values, 100.0)
    plain = Path(write_recording(recording, folder / f"a{suffix}"))
    other = Path(os.fsdecode(os.fsencode(folder) + b"/b\xff" + suffix.encode()))
    other.write_bytes(plain.read_bytes())
    return other


@pytest.mark.parametrize("suffix", [form.suffixes[0] for form in FORMATS.values()])
def test_every_format_is_read(suffix, tmp_path):
    if suffix in (".mcap", ".db3", ".bag"):
        with pytest.raises(DataError, match="the name of a bag must be UTF-8"):
            read_recording(odd(tmp_path, suffix))
        return
    assert read_recording(odd(tmp_path, suffix)).samples == 100


def test_the_name_of_its_recording_has_the_byte_as_an_escape(tmp_path):
    odd(tmp_path, ".csv")
    assert [recording.name for recording in read_data_set(tmp_path)] == ["a", "b\\xff"]


def test_the_command_line_goes_on_and_its_json_is_sound(tmp_path):
    odd(tmp_path, ".csv")
    for options in ([], ["--json"]):
        done = CliRunner().invoke(app, ["data", "check", str(tmp_path), *options])
        assert done.exit_code in (0, 3), done.output
        assert "b\\xff" in done.output or "b\\\\xff" in done.output
    assert len(json.loads(done.stdout)["recordings"]) == 2
