"""Buckets of Google Cloud and Azure, against servers of their protocols: as those of S3."""

import sys
from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError, StorageError
from edp.logs import buckets, read_data_set, write_recording
from edp.logs.source import DataSource
from edp.logs.store import read_store, remote
from edp.recording import Recording
from edp.signals import Channel, Kind

sys.path.insert(0, str(Path(__file__).parent))
from cloud_servers import ACCOUNT, AzureHandler, GoogleHandler
from s3_server import serving

CHANNELS = (Channel("u", Kind.RATIO), Channel("v", Kind.VELOCITY))
KEY = "c2VjcmV0"


@pytest.fixture
def top(tmp_path):
    """A server's folder with the bucket `fleet`, and logs of two machines below `logs`."""
    folder = tmp_path / "server"
    for number in range(3):
        values = np.random.default_rng(number).normal(size=(300 + number, 2)).astype(np.float32)
        recording = Recording(f"run{number}", CHANNELS, values, 50.0, "sim:test")
        write_recording(recording, folder / "fleet" / "logs" / f"machine{number % 2}" / f"run{number}.parquet")
    return folder


@pytest.fixture(params=["gs", "az"])
def server(request, top, tmp_path, monkeypatch):
    remote.is_remote_store.cache_clear()
    monkeypatch.setenv("EDP_CACHE", str(tmp_path / "cache"))
    with serving(top, GoogleHandler if request.param == "gs" else AzureHandler) as running:
        endpoint = f"http://127.0.0.1:{running.server_port}"
        for name, value in {
            "STORAGE_EMULATOR_HOST": endpoint,
            "AZURE_STORAGE_ENDPOINT": endpoint,
            "AZURE_STORAGE_ACCOUNT": ACCOUNT,
            "AZURE_STORAGE_KEY": KEY,
        }.items():
            monkeypatch.setenv(name, value)
        running.bucket = f"{request.param}://fleet"
        yield running


def assert_same(ours, theirs):
    assert [one.name for one in ours] == [one.name for one in theirs]
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        assert (one.channels, one.rate_hz, one.digest) == (other.channels, other.rate_hz, other.digest)


def by_name(recordings):
    return sorted(recordings, key=lambda one: one.name)


@pytest.mark.processes
def test_a_store_is_built_from_logs_and_read_from_a_bucket(server, top, tmp_path, monkeypatch):
    monkeypatch.setattr(buckets, "PIECE_BYTES", 1000)  # several pieces of each object
    expected = [read_data_set(top / "fleet" / "logs" / name) for name in ("machine0", "machine1")]
    expected = by_name([one for part in expected for one in part])
    source = DataSource.from_path(f"{server.bucket}/logs")
    assert source.store(tmp_path / "store").refused == ()
    assert_same(by_name(read_store(tmp_path / "store")), expected)
    source.store(top / "fleet" / "stores" / "first")
    stored = DataSource.from_path(f"{server.bucket}/stores/first")
    assert stored.stored
    assert_same(by_name(stored.read()), expected)


@pytest.mark.processes
def test_samples_that_are_not_what_the_index_says_are_refused(server, top):
    DataSource.from_path(top / "fleet" / "logs" / "machine0").store(top / "fleet" / "store")
    server.mode = "cut"
    with pytest.raises(DataError, match="have other samples than their hash"):
        DataSource.from_path(f"{server.bucket}/store").read()


def test_refusals_and_missing_keys_are_said_in_words(server, tmp_path):
    with pytest.raises(DataError, match="/nothing' does not exist"):
        DataSource.from_path(f"{server.bucket}/nothing").store(tmp_path / "store")
    server.mode = "refuse"
    with pytest.raises(StorageError, match=r"the bucket refuses to be read .* set (GOOGLE|AZURE)"):
        DataSource.from_path(f"{server.bucket}/logs").store(tmp_path / "store")
    assert not (tmp_path / "store" / "store.json").exists()


def test_a_server_that_hangs_within_an_object_is_left_after_a_bounded_time(server, tmp_path, monkeypatch):
    """The interpreter must not be held: the limit of time counts in another thread."""
    reader = buckets.BucketReader(server.bucket)
    (file, *_) = reader.objects(f"{server.bucket}/logs")
    monkeypatch.setattr(buckets, "STEP_S", 0.5)
    server.mode, server.hang_s = "hang", 2.0
    with pytest.raises(StorageError, match=r"did not answer within 0.5 s"):
        reader.copy(file, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_an_object_that_grew_is_refused(server, top, tmp_path):
    reader = buckets.BucketReader(server.bucket)
    (file, *_) = reader.objects(f"{server.bucket}/logs")
    grown = top / "fleet" / "logs" / "machine0" / file.name
    grown.write_bytes(grown.read_bytes() + bytes(100))
    with pytest.raises(DataError, match=r"it was changed"):
        reader.copy(file, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        ("http://127.0.0.1:40340/fleet failed", False),
        ("object 'run403.parquet' is broken", False),
        ("HTTP status 403", True),
        ("Azure Error: [AuthenticationFailed]", True),
        ("PERMISSION_DENIED: Permanent error", True),
        ("Access Denied", True),
    ],
)
def test_a_port_or_a_name_is_no_refusal(server, text, refused):
    said = str(buckets.BucketReader(server.bucket)._describe_error(OSError(text), "the address"))
    assert ("refuses to be read" in said) == refused
