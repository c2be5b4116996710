"""Logs and stores in buckets: the same recordings as on this machine, and an error in words in bounded time."""

import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, DataError, StorageError
from edp.logs import buckets, read_data_set, write_recording
from edp.logs.buckets import BucketReader, bucket_address, cache_folder
from edp.logs.source import DataSource
from edp.logs.store import read_store, remote
from edp.recording import Recording
from edp.signals import Channel, Kind

sys.path.insert(0, str(Path(__file__).parent))
from s3_server import serving

pytestmark = pytest.mark.processes

CHANNELS = (Channel("u", Kind.RATIO), Channel("p", Kind.PRESSURE, "head side"), Channel("v", Kind.VELOCITY))


@pytest.fixture
def top(tmp_path):
    """A server's folder with the bucket `fleet`, and four logs below `logs`."""
    folder = tmp_path / "server"
    for number in range(4):
        values = np.random.default_rng(number).normal(size=(300 + number, 3)).astype(np.float32)
        recording = Recording(f"run{number}", CHANNELS, values, 50.0, "sim:test")
        write_recording(recording, folder / "fleet" / "logs" / f"run{number}.parquet")
    (folder / "fleet" / "logs" / "notes.pdf").write_bytes(b"no log")
    return folder


@pytest.fixture
def server(top, tmp_path, monkeypatch):
    remote.is_remote_store.cache_clear()
    monkeypatch.setenv("EDP_CACHE", str(tmp_path / "cache"))
    for name, value in {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(name, value)
    with serving(top) as running:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{running.server_port}")
        yield running


def assert_same(ours, theirs):
    assert [one.name for one in ours] == [one.name for one in theirs]
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one.values, other.values)
        assert (one.channels, one.rate_hz, one.digest) == (other.channels, other.rate_hz, other.digest)


@pytest.mark.parametrize(
    ("path", "address"),
    [
        ("s3://a/b/c", "s3://a/b/c"),
        (Path("s3://a/b/c"), "s3://a/b/c"),
        ("gs://a", "gs://a"),
        ("az://a/b/", "az://a/b"),
        ("logs/s3", ""),
        ("/s3/a", ""),
        ("http://a/b", ""),
    ],
)
def test_addresses_are_told_from_paths(path, address):
    assert bucket_address(path) == address


def test_a_store_is_built_from_logs_in_a_bucket(server, top, tmp_path):
    index = DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")
    assert_same(read_store(tmp_path / "store"), read_data_set(top / "fleet" / "logs"))
    assert [entry.log for entry in index.recordings] == [f"s3://fleet/logs/run{i}.parquet" for i in range(4)]
    assert index.refused == ()
    # Logs that are in the store are listed, and not read again.
    before = len(server.requests)
    DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")
    assert not any(".parquet" in path for method, path, _ in server.requests[before:] if method == "GET")


def test_a_store_in_a_bucket_is_copied_once_and_read(server, top, tmp_path):
    DataSource.from_path(top / "fleet" / "logs").store(top / "fleet" / "stores" / "first")
    source = DataSource.from_path("s3://fleet/stores/first")
    assert source.stored
    assert_same(source.read(), read_data_set(top / "fleet" / "logs"))
    assert all(one.on_disk for one in source.read())
    before = len(server.requests)
    again = DataSource.from_dict(source.to_dict())
    assert source.to_dict()["path"] == "s3://fleet/stores/first"
    assert_same(again.read(), read_data_set(top / "fleet" / "logs"))
    assert not any(".f32" in path for _, path, _ in server.requests[before:])


def test_a_store_that_was_added_to_is_copied_anew(server, top):
    store = top / "fleet" / "store"
    DataSource.from_path(top / "fleet" / "logs" / "run0.parquet").store(store)
    assert len(DataSource.from_path("s3://fleet/store").read()) == 1
    DataSource.from_path(top / "fleet" / "logs").store(store)
    assert_same(DataSource.from_path("s3://fleet/store").read(), read_data_set(top / "fleet" / "logs"))


def test_samples_that_are_not_what_the_index_says_are_refused_and_copied_again(server, top):
    DataSource.from_path(top / "fleet" / "logs").store(top / "fleet" / "store")
    server.mode = "cut"
    with pytest.raises(DataError, match="have other samples than their hash"):
        DataSource.from_path("s3://fleet/store").read()
    server.mode = "ok"
    assert_same(DataSource.from_path("s3://fleet/store").read(), read_data_set(top / "fleet" / "logs"))


def test_a_copy_that_was_stopped_goes_on(server, top, monkeypatch):
    monkeypatch.setattr("edp.logs.store.building.BATCH_LOG_BYTES", 1)
    DataSource.from_path(top / "fleet" / "logs").store(top / "fleet" / "store")
    real, copies = BucketReader.copy, []

    def stop(self, file, target):
        if len(copies) == 2:
            raise KeyboardInterrupt
        copies.append(file)
        return real(self, file, target)

    monkeypatch.setattr(BucketReader, "copy", stop)
    with pytest.raises(KeyboardInterrupt):
        DataSource.from_path("s3://fleet/store").read()
    monkeypatch.setattr(BucketReader, "copy", real)
    before = len(server.requests)
    assert_same(DataSource.from_path("s3://fleet/store").read(), read_data_set(top / "fleet" / "logs"))
    fetched = {path for method, path, _ in server.requests[before:] if method == "GET" and ".f32" in path}
    assert len(fetched) == 2


def test_a_bucket_that_refuses_a_missing_key_and_no_logs_are_said_in_words(server, top, tmp_path):
    for address, message in (
        ("s3://fleet/nothing", r"'s3://fleet/nothing' does not exist"),
        ("s3://nowhere/logs", r"s3://nowhere/logs"),
        ("s3://fleet/logs/notes.pdf", r"1 object\(s\), none with the ending of a log"),
    ):
        with pytest.raises((DataError, StorageError), match=message):
            DataSource.from_path(address).store(tmp_path / "store")
    server.mode = "refuse"
    with pytest.raises(StorageError, match=r"the bucket refuses to be read .* set AWS_ACCESS_KEY_ID"):
        DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")


def test_an_endpoint_that_hangs_is_left_after_a_bounded_time(server, tmp_path, monkeypatch):
    monkeypatch.setattr(buckets, "STEP_S", 0.5)
    server.mode, server.hang_s = "hang", 2.0
    with pytest.raises(StorageError, match=r"did not answer within 0.5 s"):
        DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")
    assert not (tmp_path / "store" / "store.json").exists()


def test_a_log_that_cannot_be_copied_is_refused_and_tried_again(server, top, tmp_path, monkeypatch):
    real = BucketReader.copy

    def fail(self, file, target):
        if "run2" in file.address:
            raise StorageError(f"'{file.address}' did not answer within 1 s")
        return real(self, file, target)

    monkeypatch.setattr(BucketReader, "copy", fail)
    index = DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")
    assert [one.log for one in index.refused] == ["s3://fleet/logs/run2.parquet"]
    monkeypatch.setattr(BucketReader, "copy", real)
    assert DataSource.from_path("s3://fleet/logs").store(tmp_path / "store").refused == ()
    assert_same(read_store(tmp_path / "store"), read_data_set(top / "fleet" / "logs"))


def test_a_disk_without_room_is_refused_before_the_copy(server, top, monkeypatch):
    DataSource.from_path(top / "fleet" / "logs").store(top / "fleet" / "store")
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(buckets.shutil, "disk_usage", lambda folder: usage._replace(free=10))
    with pytest.raises(StorageError, match=r"choose another disk \(EDP_CACHE"):
        DataSource.from_path("s3://fleet/store").read()
    assert not list(cache_folder().rglob("*.f32"))


def test_what_a_bucket_is_not_for_is_refused(server, top, tmp_path):
    with pytest.raises(
        ConfigError, match=r"holds logs and no store; read them once with `edp data store build s3://fleet"
    ):
        DataSource.from_path("s3://fleet/logs").read()
    with pytest.raises(ConfigError, match=r"a store is built on this machine"):
        DataSource.from_path(top / "fleet" / "logs").store("s3://fleet/store")
    with pytest.raises(ConfigError, match=r"holds credentials or options"):
        BucketReader("s3://key:secret@fleet/logs")
    with pytest.raises(ConfigError, match=r"set AZURE_STORAGE_ACCOUNT"):
        BucketReader("az://fleet/logs")


def test_a_data_set_file_names_logs_in_buckets(server, top, tmp_path):
    (tmp_path / "set.toml").write_text(
        '[[recordings]]\npath = "s3://fleet/logs/run1.parquet"\nrows = [10, 90]\nname = "first"\nmachine = "M7"\n'
    )
    DataSource.from_path(tmp_path / "set.toml").store(tmp_path / "store")
    (one,) = read_store(tmp_path / "store")
    np.testing.assert_array_equal(one.values, read_data_set(top / "fleet" / "logs")[1].values[10:90])
    assert (one.name, one.meta["machine"]) == ("first", "M7")


@pytest.mark.slow
def test_another_server_of_the_protocol_gives_the_same(top, tmp_path, server, monkeypatch):
    """Against moto, where its server is installed: what this folder's server leaves out must not matter."""
    program = shutil.which("moto_server")
    if program is None:
        pytest.skip("moto_server is not installed")
    with subprocess.Popen([program, "-p", "5655"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            endpoint = "http://127.0.0.1:5655"
            _put(f"{endpoint}/fleet", b"")
            for path in sorted((top / "fleet").rglob("*.parquet")):
                _put(f"{endpoint}/fleet/{path.relative_to(top / 'fleet').as_posix()}", path.read_bytes())
            monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
            DataSource.from_path("s3://fleet/logs").store(tmp_path / "store")
            assert_same(read_store(tmp_path / "store"), read_data_set(top / "fleet" / "logs"))
        finally:
            process.kill()


def _put(address, content, attempts=100):
    import time

    for _ in range(attempts):
        try:
            request = urllib.request.Request(
                address, content, {"Content-Type": "application/octet-stream"}, method="PUT"
            )
            urllib.request.urlopen(request, timeout=60).close()
            return
        except OSError:
            time.sleep(0.2)  # the server is starting
    raise AssertionError(f"{address} did not answer")
