"""Bad input gives one clear error, and a failed write leaves nothing behind."""

from __future__ import annotations

import errno
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.logs import FORMATS, LAYOUTS, WriteOptions, inspect_log, read_recording, write_recording
from edp.logs.formats.edp_metadata import facts_text, parse_edp_metadata
from edp.logs.formats.matlab.check import check_size
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes

SUFFIXES = [part.suffixes[0] for part in FORMATS.values()]


def make(rows=300):
    rng = np.random.default_rng(1)
    channels = tuple(TABLE_A1[name] for name in ("BmUp", "CylVels_1"))
    return Recording("R", channels, rng.standard_normal((rows, 2)).astype(np.float32), 100.0)


def attempt(path):
    """The recording, or why there is none."""
    try:
        return read_recording(path), ""
    except DataError as error:
        return None, str(error)


def same_columns(one, other):
    """Bit by bit; a text file, or one that lost EDP's facts, has the vocabulary's order."""
    names = sorted(other.channel_names)
    return sorted(one.channel_names) == names and one.select(names).tobytes() == other.select(names).tobytes()


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
    with pytest.raises(DataError, match="2 columns named 'BmUp'"):
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
    def refuse(target):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("edp.storage.writing._temporary", refuse)
    with pytest.raises(StorageError, match="Permission denied"):
        write_recording(make(), tmp_path / "a.csv")


def test_unreadable_file(tmp_path, monkeypatch):
    path = write_recording(make(), tmp_path / "a.csv")

    def refuse(place, *_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", str(place))

    monkeypatch.setattr("edp.logs.detect.os.open", refuse)
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


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_a_mat_file_that_unpacks_to_more_than_memory_is_refused_unread(tmp_path, version):
    """A zip bomb: some kilobytes that announce gigabytes."""
    path = tmp_path / "bomb.mat"
    if version == "5":
        zeros = zlib.compress(struct.pack("<II", 14, 0xFFFFFFF0) + bytes(1 << 20))
        element = struct.pack("<II", 15, len(zeros)) + zeros
        path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + element * 20)
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            file.create_dataset("x", shape=(1, 1 << 44), dtype="f8", chunks=(1, 1 << 10), compression="gzip")
            file["x"].attrs["MATLAB_class"] = np.bytes_(b"double")
        with path.open("rb+") as stream:
            stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    assert path.stat().st_size < 1 << 20
    match = r"claims 4294967280 bytes, packed" if version == "5" else r"'x' claims \d+ bytes, packed into 0"
    with pytest.raises(DataError, match=rf"{match}.* made to exhaust memory"):
        read_recording(path)


def test_a_mat_file_larger_than_free_memory_is_refused_unread(tmp_path, monkeypatch):
    path = tmp_path / "large.mat"
    scipy.io.savemat(path, {"x": np.zeros((100_000, 1))})
    monkeypatch.setattr("edp.storage.memory.free_bytes", lambda: 1_000_000)
    with pytest.raises(DataError, match=r"variables of this MAT file would take .* of memory.*made to exhaust memory"):
        check_size(path)


@pytest.mark.parametrize(
    ("name", "head", "message"),
    [
        ("a.mat", b"PK\x03\x04\x14\x00\x01\x00" + bytes(60), "a password-protected ZIP archive"),
        ("a.csv", b"<!DOCTYPE html><html><body>Sign in</body></html>", "a web page instead of the data"),
        ("a.csv", b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "run 'git lfs pull'"),
        ("a.parquet", b"Salted__" + bytes(60), r"encrypted data \(decrypt it first\)"),
        ("a.mf4", bytes(5000), "begins with zeros only; it is half downloaded"),
        ("a.mcap", b"\x89MCAP0\r\n" + bytes(500), "has no end"),
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(500), "cannot be read"),
        ("a.db3", b"SQLite format 3\0" + bytes(500), "cannot be read"),
        ("a.mf4.crdownload", b"MDF", "the download is not finished"),
        ("a.bag.active", b"#ROSBAG", "rosbag reindex"),
        ("a.mldatx", b"PK", "press Export and choose a MAT, Parquet or CSV file"),
    ],
)
def test_what_is_not_a_log_is_named(tmp_path, name, head, message):
    (tmp_path / name).write_bytes(head)
    with pytest.raises(DataError, match=message):
        read_recording(tmp_path / name)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_empty_file_of_each_format(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"")
    with pytest.raises(DataError, match="is empty"):
        read_recording(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_half_downloaded_file_of_each_format(tmp_path, suffix):
    """Browsers write what they have, others the whole length with zeros where the rest will be."""
    whole = write_recording(make(3000), tmp_path / f"a{suffix}").read_bytes()
    half = len(whole) // 2
    for data in (whole[:half], whole[:half] + bytes(len(whole) - half)):
        (tmp_path / f"a{suffix}").write_bytes(data)
        read, message = attempt(tmp_path / f"a{suffix}")
        if read is None:
            assert f"a{suffix}" in message
            continue
        # Lines of text that are whole are a shorter log.
        assert suffix == ".csv"
        assert read.samples < 3000
        assert same_columns(read.rows(0, read.samples - 1), make(3000).rows(0, read.samples - 1))


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix != ".csv"])
def test_numbers_changed_behind_our_back_are_never_read_silently(tmp_path, suffix):
    """EDP's own files state the digest of their values, whatever the container checks."""
    recording = make(400)
    whole = bytearray(write_recording(recording, tmp_path / f"a{suffix}").read_bytes())
    for place in np.random.default_rng(5).integers(len(whole) // 4, len(whole), 40):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        (tmp_path / f"a{suffix}").write_bytes(damaged)
        read, message = attempt(tmp_path / f"a{suffix}")
        assert f"a{suffix}" in message if read is None else same_columns(read, recording)


def test_text_block_by_block_is_read_as_the_whole(tmp_path, monkeypatch):
    recording = make(5000)
    path = write_recording(recording, tmp_path / "a.csv")
    monkeypatch.setattr("edp.logs.formats.csv_table.WHOLE_BYTES", 0)
    monkeypatch.setattr("edp.logs.formats.csv_table._BLOCK_BYTES", 4096)
    assert same_columns(read_recording(path), recording)
    assert same_columns(read_recording(path, rows=(1234, 1300)), recording.rows(1234, 1300))
    with path.open("a") as stream:
        stream.write("50.00,1,2\n50.01,oops,2\n")
    with pytest.raises(DataError, match=r"column 'BmUp' holds text 'oops' in line 5003"):
        read_recording(path)
    with path.open("a") as stream:
        stream.write("50.00,1\n")
    with pytest.raises(DataError, match="has 2 cells, the header has 3"):
        read_recording(path)


def test_one_name_in_two_variables_is_never_chosen_silently(tmp_path):
    time = np.arange(9.0)
    struct = {"time": time, "BmUp": time, "BmDwn": time}
    scipy.io.savemat(tmp_path / "a.mat", {"left": struct, "right": {"time": time, "BmUp": 2 * time}})
    with pytest.raises(DataError, match=r"2 columns named 'BmUp': left.BmUp, right.BmUp; name the wanted one"):
        read_recording(tmp_path / "a.mat")
    read = read_recording(tmp_path / "a.mat", SignalMap((ChannelMap("BmUp", "right.BmUp"),)))
    assert read.values[-1, 0] == 16.0


@pytest.mark.parametrize("key", ["dig\u0435st", "digess", "more"])
def test_facts_with_a_key_that_is_not_known_are_damaged(key):
    text = facts_text(Recording("r", (Channel("u", Kind.GENERIC),), np.zeros((3, 1), np.float32), 100.0))
    assert parse_edp_metadata(text, "'r.mat'").digest
    with pytest.raises(DataError, match="which this version does not know"):
        parse_edp_metadata(text.replace('"digest"', f'"{key}"'), "'r.mat'")
