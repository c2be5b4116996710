"""Bad input gives one clear error, and a failed write leaves nothing behind."""

from __future__ import annotations

import errno
import tempfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.logs import FORMATS, LAYOUTS, WriteOptions, inspect_log, read_recording, write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap

SUFFIXES = [part.suffixes[0] for part in FORMATS.values()]


def make(rows=300):
    rng = np.random.default_rng(1)
    channels = tuple(TABLE_A1[name] for name in ("BmUp", "CylVels_1"))
    return Recording("R", channels, rng.standard_normal((rows, 2)).astype(np.float32), 100.0)


def text(tmp_path, content, name="a.csv"):
    path = tmp_path / name
    path.write_text(content)
    return path


def test_misspelt_column_offers_the_closest(tmp_path):
    path = text(tmp_path, "time,BoomUp,x\n0,1,1\n0.01,2,2\n0.02,3,3\n")
    with pytest.raises(DataError, match=r"no column 'BoomUpp'; did you mean 'BoomUp'\?"):
        read_recording(path, SignalMap((ChannelMap("BmUp", "BoomUpp"),)))
    with pytest.raises(DataError, match=r"no time column 'tim'; did you mean 'time'\?"):
        read_recording(path, SignalMap((ChannelMap("BmUp", "BoomUp"),), time="tim"))


def test_nothing_of_the_vocabulary_offers_the_closest(tmp_path):
    path = text(tmp_path, "time,CylVel_1\n0,1\n0.01,2\n0.02,3\n")
    with pytest.raises(DataError, match=r"'CylVel_1'; did you mean 'CylVels_1'\?"):
        read_recording(path)


@pytest.mark.parametrize(
    ("unit", "message"), [("baar", "unknown unit 'baar'.*did you mean 'bar'"), ("mm/s", "does not measure 'pilot_pr")]
)
def test_wrong_unit(tmp_path, unit, message):
    path = text(tmp_path, "time,BmUp\n0,1\n0.01,2\n0.02,3\n")
    with pytest.raises(DataError, match=message) as caught:
        read_recording(path, SignalMap((ChannelMap("BmUp", "BmUp", unit),)))
    assert "BmUp" in str(caught.value)
    assert "a.csv" in str(caught.value)
    path = text(tmp_path, f"time,BmUp [{unit}]\n0,1\n0.01,2\n0.02,3\n")
    with pytest.raises(DataError, match=message):
        read_recording(path)


def test_no_time_column(tmp_path):
    path = text(tmp_path, "BmUp\n1\n2\n3\n")
    with pytest.raises(DataError, match="sample_time_s"):
        read_recording(path)
    assert read_recording(path, SignalMap(sample_time_s=0.5)).rate_hz == 2.0


def test_text_among_numbers_names_column_and_line(tmp_path):
    rows = "".join(f"{i / 100},{i}\n" for i in range(5000))
    path = text(tmp_path, f"time,BmUp\n{rows}50.00,oops\n")
    with pytest.raises(DataError, match=r"column 'BmUp' holds text 'oops' in line 5002"):
        read_recording(path)
    assert any("oops" in finding.what for finding in inspect_log(path).findings)


def test_ragged_row_and_doubled_column(tmp_path):
    path = text(tmp_path, "time,BmUp,BmDwn\n0,1,2\n0.01,2\n0.02,3,3\n")
    with pytest.raises(DataError, match="line 3 has 2 cells, the header has 3"):
        read_recording(path)
    path = text(tmp_path, "time,BmUp,BmUp\n0,1,2\n0.01,2,2\n0.02,3,3\n")
    with pytest.raises(DataError, match="two columns named 'BmUp'"):
        read_recording(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("named", SUFFIXES)
def test_file_that_is_not_what_its_ending_says(tmp_path, suffix, named):
    if suffix == named:
        return
    held = FORMATS[{part.suffixes[0]: name for name, part in FORMATS.items()}[suffix]].content
    write_recording(make(), tmp_path / f"a{suffix}").rename(tmp_path / f"a{named}")
    with pytest.raises(DataError, match=f"is named {named} but holds {held}"):
        read_recording(tmp_path / f"a{named}")


def test_other_endings_say_how_to_export(tmp_path):
    path = text(tmp_path, "x", "run.mldatx")
    with pytest.raises(DataError, match="Simulation Data Inspector"):
        read_recording(path)
    (tmp_path / "a.csv").write_bytes(b"PK\x03\x04" + bytes(60))
    with pytest.raises(DataError, match="ZIP archive"):
        read_recording(tmp_path / "a.csv")
    with pytest.raises(DataError, match="is empty"):
        read_recording(text(tmp_path, "", "e.csv"))
    with pytest.raises(DataError, match="No such file"):
        read_recording(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("name", "options"),
    [("a.csv", None), ("a.parquet", None)]
    + [("a.mat", WriteOptions(layout, version)) for layout in LAYOUTS for version in ("v5", "v7.3")],
)
def test_truncated_files_give_data_errors_only(tmp_path, name, options):
    recording = make(120)
    whole = write_recording(recording, tmp_path / name, options).read_bytes()
    rng = np.random.default_rng(7)
    refused = 0
    offsets = [1, 4, 100, 127, 129, len(whole) - 1, *rng.integers(1, len(whole), 12).tolist()]
    for offset in offsets:
        (tmp_path / name).write_bytes(whole[:offset])
        try:
            read = read_recording(tmp_path / name)
        except EdpError as error:
            refused += name in str(error)
        else:
            # A text file cut between two rows, or inside its last number, cannot be told from a shorter one.
            assert read.samples <= recording.samples
    if not name.endswith(".csv"):
        assert refused >= len(offsets) - 1


@pytest.mark.parametrize("suffix", [".parquet", ".mat"])
def test_flipped_bytes_never_escape_as_other_errors(tmp_path, suffix):
    whole = bytearray(write_recording(make(120), tmp_path / f"a{suffix}").read_bytes())
    rng = np.random.default_rng(3)
    for _ in range(15):
        damaged = bytearray(whole)
        for place in rng.integers(130, len(whole), 8):
            damaged[place] ^= int(rng.integers(1, 256))
        (tmp_path / f"a{suffix}").write_bytes(damaged)
        try:
            read_recording(tmp_path / f"a{suffix}")
        except EdpError:
            continue


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_full_disk_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = write_recording(make(), tmp_path / f"a{suffix}")
    before = path.read_bytes()

    def full(self, recording, target, options):
        with target.open("wb") as stream:
            stream.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    part = next(part for part in FORMATS.values() if suffix in part.suffixes)
    monkeypatch.setattr(type(part), "write", full)
    with pytest.raises(StorageError, match="No space left on device"):
        write_recording(make(500), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".mat"])
def test_each_writer_reports_a_full_disk_as_os_error(suffix):
    part = next(part for part in FORMATS.values() if suffix in part.suffixes)
    with pytest.raises(OSError):  # noqa: PT011  (the message is the system's)
        part.write(make(200_000), Path("/dev/full"), WriteOptions())


def test_read_only_folder(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(tempfile, "mkstemp", refuse)
    with pytest.raises(StorageError, match="Permission denied"):
        write_recording(make(), tmp_path / "a.csv")


def test_unreadable_file(tmp_path, monkeypatch):
    path = write_recording(make(), tmp_path / "a.csv")

    def refuse(self, *args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(DataError, match="Permission denied"):
        read_recording(path)


def test_mat_faults(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"t": np.arange(9.0), "BmUp": np.arange(8.0)})
    with pytest.raises(DataError, match="no time column that fits 'BmUp'"):
        read_recording(tmp_path / "a.mat")
    scipy.io.savemat(tmp_path / "b.mat", {"note": "only text", "k": 3.0})
    with pytest.raises(DataError, match="holds no signals"):
        read_recording(tmp_path / "b.mat")
    with pytest.raises(DataError, match="no variable 'T'"):
        read_recording(tmp_path / "a.mat", SignalMap(variable="T"))
    lengths = {"BmUp": np.arange(8.0), "BmDwn": np.arange(7.0)}
    scipy.io.savemat(tmp_path / "c.mat", lengths)
    with pytest.raises(DataError, match="'BmDwn' has 7 rows, 'BmUp' has 8"):
        read_recording(tmp_path / "c.mat", SignalMap(sample_time_s=1.0))


def test_writers_refuse_what_they_cannot_hold(tmp_path):
    odd = Recording("x", (Channel("oil temp", Kind.TEMPERATURE),), np.ones((3, 1), dtype=np.float32), 1.0)
    with pytest.raises(DataError, match="cannot be MATLAB names"):
        write_recording(odd, tmp_path / "x.mat")
    with pytest.raises(ConfigError, match="unknown MAT layout 'structs'; did you mean 'struct'"):
        write_recording(make(), tmp_path / "x.mat", WriteOptions("structs"))
    with pytest.raises(DataError, match="MAT version 'v6'"):
        write_recording(make(), tmp_path / "x.mat", WriteOptions(mat_version="v6"))
    with pytest.raises(DataError, match="nothing is written"):
        write_recording(Recording("x", (), np.empty((0, 0), dtype=np.float32), 1.0), tmp_path / "x.csv")
    assert not list(tmp_path.iterdir())


def test_rows_out_of_range(tmp_path):
    path = write_recording(make(), tmp_path / "a.parquet")
    assert read_recording(path, rows=(10, None)).samples == 290
    with pytest.raises(DataError, match=r"rows 0:301 asked for, but 0 <= start < stop <= 300"):
        read_recording(path, rows=(0, 301))
