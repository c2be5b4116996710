"""A store from a stranger: its index leads to no other file, asks for no memory, and damage is one error."""

import json
import os
import shutil
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edp.errors import DataError, EdpError
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.logs.store import check_store, opening, read_store
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage import write_json
from edp.storage.seals import files_without_seal


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    channels = (Channel("u", Kind.RATIO), Channel("v", Kind.VELOCITY))
    for name in ("a", "b"):
        values = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
        write_recording(Recording(name, channels, values, 10.0), folder / "logs" / f"{name}.parquet")
    assert not DataSource.from_path(folder / "logs").store(folder / "store").refused
    return folder / "store"


@pytest.fixture
def altered(store):
    """Write the index with a change; the store is whole again afterwards."""
    path = store / "store.json"
    whole = path.read_bytes()

    def change(edit):
        table = json.loads(whole)
        edit(table)
        try:
            write_json(path, table)
        except ValueError:  # a number that is not finite has no hash
            path.write_text(json.dumps(table))
        return store

    yield change
    path.write_bytes(whole)


def entry(**values):
    return lambda table: table["recordings"][0].update(values)


ATTACKS = {
    "a file outside the store": (
        lambda table: [row.update(key="../../logs/a") for row in table["files"]],
        "32 hexadecimal digits",
    ),
    "an absolute path": (lambda table: table["files"][0].update(key="/etc/passwd"), "32 hexadecimal digits"),
    "a key that ends in a line break": (
        lambda table: table["files"][0].update(key="0" * 32 + "\n"),
        "32 hexadecimal digits",
    ),
    "a file that is not listed": (entry(rows="0" * 32), "which the store does not have"),
    "samples beyond the file": (entry(samples=10**15), "which the store does not have"),
    "no samples": (entry(samples=0), "which the store does not have"),
    "samples before the file": (entry(first=-2), "which the store does not have"),
    "a list of channels that is not there": (entry(channels=7), "there are 1"),
    "the last list of channels": (entry(channels=-1), "there are 1"),
    "no channels": (lambda table: table.update(lists=[[]]), "none may be empty"),
    "a rate of nothing": (entry(rate_hz=0.0), "0 < a rate <="),
    "a text for a number": (entry(samples="50"), "samples"),
    "an unknown key": (entry(pickle="gASV"), "pickle"),
    "facts that are no object": (entry(meta="[1]"), "damaged"),
    "facts that are no JSON": (entry(meta="{"), "not valid JSON"),
    "facts of great depth": (entry(meta="[" * 5000 + "]" * 5000), "not valid JSON"),
    "a channel with a line break": (lambda table: table["lists"][0][0].update(name="a\nb"), "control characters"),
    "a channel twice": (lambda table: table["lists"][0][0].update(name="v"), "occur twice"),
    "an unknown kind": (lambda table: table["lists"][0][0].update(kind="soul"), "kind"),
    "another schema": (lambda table: table.update(schema=3), "schema 3, this version of EDP reads 1 and 2"),
    "a rate beyond all sensors": (entry(rate_hz=1e7), "0 < a rate <="),
    "an empty hash": (entry(digest=""), "32 hexadecimal digits"),
    "a size below nothing": (lambda table: table["files"][0].update(bytes=-4), "out of bounds"),
    "a time beyond all clocks": (lambda table: table["files"][0].update(changed_ns=2**80), "out of bounds"),
    "another kind of file": (lambda table: table.update(kind="edp-bundle"), "no store of EDP"),
    "a size that is not that of the file": (lambda table: table["files"][0].update(bytes=10**12), "were stored"),
    "another hash": (lambda table: (entry(digest="0" * 32)(table), table["files"][0].update(written_ns=1)), "changed"),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_an_altered_index_is_one_error(altered, name):
    edit, message = ATTACKS[name]
    with pytest.raises(DataError, match=message):
        read_store(altered(edit))


def test_an_index_that_is_no_json_is_one_error(altered, store):
    altered(lambda table: None)
    for content in (b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"kind": NaN}', b"[" * 100_000):
        (store / "store.json").write_bytes(content)
        with pytest.raises(DataError):
            read_store(store)


@pytest.mark.parametrize("kind", ["link", "folder", "pipe"])
def test_rows_that_are_no_file_of_the_store_are_refused(altered, store, tmp_path, kind):
    path = next((store / "rows").glob("*.f32"))
    kept = tmp_path / "kept"
    os.rename(path, kept)
    try:
        if kind == "link":
            path.symlink_to(kept)
        elif kind == "folder":
            path.mkdir()
        else:
            os.mkfifo(path)
        for read in (read_store, check_store):
            with pytest.raises(DataError, match="must be a regular file of the store"):
                read(store)
    finally:
        path.rmdir() if kind == "folder" else path.unlink()
        os.rename(kept, path)


VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(max_size=40),
    st.lists(st.integers(), max_size=3),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_value_in_an_index_is_read_or_refused(altered, data):
    def edit(table):
        part = data.draw(st.sampled_from(["top", "recordings", "files", "lists"]))
        place = {
            "top": table,
            "recordings": table["recordings"][0],
            "files": table["files"][0],
            "lists": table["lists"][0][0],
        }[part]
        place[data.draw(st.sampled_from(sorted(place)))] = data.draw(VALUES)

    folder = altered(edit)
    # Any other kind of error ends the test.
    with suppress(EdpError):
        assert all(np.isfinite(one.rate_hz) and one.values.ndim == 2 for one in read_store(folder))


UNDER_THE_HASH = {
    "another rate": entry(rate_hz=20.0),
    "swapped channels": lambda table: table["lists"][0].reverse(),
    "another kind": lambda table: table["lists"][0][0].update(kind="pressure"),
    "another name": lambda table: table["lists"][0][0].update(name="w"),
    "a shortened recording": entry(samples=10),
    "a shifted recording": entry(first=2),
    "an empty hash": entry(digest=""),
    "another machine": entry(meta='{"machine": "b"}'),
    "a recording less": lambda table: table["recordings"].pop(),
    "a time of writing": lambda table: table["files"][0].update(written_ns=1),
    "a key less": lambda table: table.pop("refused"),
}


@pytest.mark.parametrize("name", UNDER_THE_HASH)
def test_a_number_changed_by_hand_is_refused_at_every_opening(altered, store, name):
    altered(lambda table: None)
    table = json.loads((store / "store.json").read_text())
    UNDER_THE_HASH[name](table)
    (store / "store.json").write_text(json.dumps(table))
    for read in (read_store, check_store):
        with pytest.raises(DataError, match=r"index of the store .* was changed since EDP wrote it"):
            read(store)


def test_an_index_without_its_hash_is_refused(altered, store):
    altered(lambda table: None)
    table = json.loads((store / "store.json").read_text())
    del table["blake2b"]
    (store / "store.json").write_text(json.dumps(table))
    with pytest.raises(DataError, match="lacks its hash"):
        read_store(store)


def test_rows_changed_under_a_kept_time_are_refused(altered, store):
    altered(lambda table: None)
    path = next((store / "rows").glob("*.f32"))
    before, content = path.stat(), path.read_bytes()
    path.write_bytes(content[:100] + b"\x00\x00\x80\x3f" + content[104:])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    try:
        for _ in range(2):
            with pytest.raises(DataError, match="changed since it was built"):
                read_store(store)
    finally:
        path.write_bytes(content)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert len(read_store(store)) == 2


def of_earlier_version(folder):
    """Write the index as versions before the hash did."""
    table = json.loads((folder / "store.json").read_text())
    del table["blake2b"]
    for file in table["files"]:
        del file["changed_ns"]
    (folder / "store.json").write_text(json.dumps(table | {"schema": 1}))


def test_a_store_of_an_earlier_version_is_compared_at_each_opening_until_it_is_checked(store, tmp_path):
    folder = shutil.copytree(store, tmp_path / "old")
    of_earlier_version(folder)
    files_without_seal()
    assert len(read_store(folder)) == 2
    assert any("index of the store" in file for file in files_without_seal())
    check_store(folder)
    assert json.loads((folder / "store.json").read_text())["schema"] == 2
    files_without_seal()
    assert len(read_store(folder)) == 2
    assert files_without_seal() == []


@pytest.mark.parametrize("name", ["another rate", "swapped channels", "another kind", "a shortened recording"])
def test_a_changed_number_of_a_store_of_an_earlier_version_is_refused(store, tmp_path, name):
    folder = shutil.copytree(store, tmp_path / "old")
    of_earlier_version(folder)
    table = json.loads((folder / "store.json").read_text())
    UNDER_THE_HASH[name](table)
    (folder / "store.json").write_text(json.dumps(table))
    with pytest.raises(DataError, match="changed since it was built"):
        read_store(folder)


def test_a_copied_store_is_compared_once_in_a_process(store, tmp_path, monkeypatch):
    folder = shutil.copytree(store, tmp_path / "copy")
    compared = []
    real = opening._refuse_changed
    monkeypatch.setattr(opening, "_refuse_changed", lambda *args: compared.append(args[0]) or real(*args))
    for _ in range(3):
        assert len(read_store(folder)) == 2
    assert len(compared) == 1
    check_store(folder)
    read_store(folder)
    assert len(compared) == 2
