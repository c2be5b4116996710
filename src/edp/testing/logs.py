"""Contract of a log format: written files are read bit for bit; damaged files give an error, not a crash."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np

from edp.errors import EdpError
from edp.logs.assemble import assemble
from edp.logs.formats.base import LogFormat, WriteOptions
from edp.logs.repair import Repair
from edp.logs.resolve import resolve
from edp.recording import Recording
from edp.signals import TABLE_A1, SignalMap
from edp.testing.expectations import ContractError, expect

# Whole, odd and slow rates, and one whose period no decimal fraction holds.
RATES_HZ = (100.0, 50.0, 128.98, 0.25, 1000.0 / 3.0)
HEAD_BYTES = 4096
"""Number of bytes of a file by which `LogFormat.claims` recognises its format."""


def sample_recording(rate_hz: float = 100.0, ticks: int = 400) -> Recording:
    """Return three channels of the vocabulary, of sizes from 0.1 to 1e7."""
    channels = tuple(TABLE_A1[name] for name in ("CylVels_1", "CylPressures_1", "BmUp"))
    # Sizes from 0.1 to 1e7 show whether a format keeps the digits of each channel.
    values = np.random.default_rng(0).standard_normal((ticks, 3)) * np.array([0.1, 1e7, 1e6])
    # A letter beyond ASCII: encodings are lost without a word.
    return Recording("R1", channels, values.astype(np.float32), rate_hz, "sim:test", {"seed": 3, "text": "ü"})


def write_log_file(form: LogFormat, recording: Recording, folder: Path) -> Path:
    """Write a recording with a format, under its first ending, and return the path."""
    path = folder / f"{recording.name}{form.suffixes[0]}"
    form.write(recording, path, WriteOptions())
    return path


def read_log(form: LogFormat, path: Path) -> Recording:
    """Read a file with a format in this process; `edp.read` uses a separate process for each log.

    Raises:
        EdpError: the file cannot be used.
    """
    raw = form.read(path, SignalMap())
    entries, problems = resolve(raw, SignalMap())
    if problems:
        raise problems[0]
    return assemble(raw, entries, SignalMap(), Repair())[0]


def check_round_trip(form: LogFormat, recording: Recording) -> None:
    """Check that a written file is read back bit for bit, with channels, rate and name.

    Raises:
        ContractError: something of it is lost or changed.
    """
    with tempfile.TemporaryDirectory(prefix="edp-format-") as folder:
        path = write_log_file(form, recording, Path(folder))
        again = read_log(form, path)
        if path.is_file():
            with path.open("rb") as stream:
                expect(form.claims(stream.read(HEAD_BYTES)), f"format '{form.name}' does not claim its own file")
    where = f"format '{form.name}' at {recording.rate_hz:g} Hz"
    expect(again.channels == recording.channels, f"{where}: channels are {again.channel_names}, or of another kind")
    expect(again.values.tobytes() == recording.values.tobytes(), f"{where}: values are not those that were written")
    # The rate comes back from stamps or periods, which may differ in the last digit.
    same_rate = math.isclose(again.rate_hz, recording.rate_hz, rel_tol=1e-9)
    expect(same_rate, f"{where}: read at {again.rate_hz!r} Hz")
    expect(again.name == recording.name, f"{where}: the recording is called '{again.name}'")


def check_damage(form: LogFormat) -> None:
    """Check that truncated files and files of other content raise a user error only.

    Raises:
        ContractError: another exception, or noise that is read as a log.
    """
    with tempfile.TemporaryDirectory(prefix="edp-format-") as folder:
        path = write_log_file(form, sample_recording(), Path(folder))
        if not path.is_file():
            return
        content = path.read_bytes()
        # Nothing, less than a head, half, and all but an end that many formats need.
        for size in (0, 10, len(content) // 2, len(content) - 10):
            path.write_bytes(content[:size])
            _is_refused(form, path, f"a file that is cut off after {size} of {len(content)} bytes")
        # Random bytes of the same length: nothing in them must be taken for a log.
        path.write_bytes(np.random.default_rng(0).bytes(len(content)))
        expect(_is_refused(form, path, "random bytes"), f"format '{form.name}' reads random bytes as a log")


def check_log_format(form: LogFormat) -> None:
    """Check the contract of a log format.

    Args:
        form: an object like those that are entered with ``FORMATS.register("name")``.

    Raises:
        ContractError: a contract is broken; the message says which and how.
    """
    expect(bool(form.name) and bool(form.content), "a format must say its `name` and its `content`")
    expect(bool(form.suffixes), f"format '{form.name}' has no endings")
    for suffix in form.suffixes:
        right = suffix.startswith(".") and suffix == suffix.lower()
        expect(right, f"format '{form.name}': the ending '{suffix}' must begin with a dot, in lower case")
    expect(isinstance(getattr(form, "parts", False), bool), f"format '{form.name}': `parts` must be True or False")
    for rate_hz in RATES_HZ:
        check_round_trip(form, sample_recording(rate_hz))
    check_damage(form)


def _is_refused(form: LogFormat, path: Path, what: str) -> bool:
    try:
        read_log(form, path)
    except EdpError:
        return True
    except Exception as error:
        raise ContractError(f"format '{form.name}' answers {what} with {type(error).__name__}: {error}") from error
    return False
