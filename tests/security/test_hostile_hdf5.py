"""MAT v7.3 files that name other files, bite their own tail, or claim more than they hold."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording, write_recording
from edp.logs.formats.base import WriteOptions
from edp.logs.formats.matlab.check import check_size
from edp.recording import Recording
from edp.signals import TABLE_A1

SECRET = np.arange(64, dtype=np.float64)


def log_in(folder: Path) -> Path:
    values = np.arange(200, dtype=np.float32).reshape(100, 2)
    recording = Recording("R", (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"]), values, 100.0)
    return write_recording(recording, folder / "a.mat", WriteOptions(mat_version="v7.3"))


def external_link(file: h5py.File, other: Path) -> None:
    file["stolen"] = h5py.ExternalLink(str(other), "/data")


def external_link_within(file: h5py.File, other: Path) -> None:
    file.create_group("log/a/b/c")["stolen"] = h5py.ExternalLink(str(other), "/data")


def external_storage(file: h5py.File, other: Path) -> None:
    file.create_dataset("stolen", shape=(8, 1), dtype="f8", external=[(str(other), 0, 64)])


def virtual(file: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout(shape=(8, 1), dtype="f8")
    layout[:, 0] = h5py.VirtualSource(str(other), "data", shape=(8,))
    file.create_virtual_dataset("stolen", layout)


def virtual_without_end(file: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout(shape=(8,), dtype="f8", maxshape=(None,))
    source = h5py.VirtualSource(str(other), "data", shape=(8,), maxshape=(None,))
    layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
    file.create_virtual_dataset("stolen", layout)


def soft_link_to_itself(file: h5py.File, _: Path) -> None:
    file["stolen"] = h5py.SoftLink("/stolen")


def soft_link(file: h5py.File, other: Path) -> None:
    file.create_group("g")["out"] = h5py.SoftLink("/log")


def by_reference(file: h5py.File, other: Path) -> None:
    """An array that no link leads to, only the reference of a cell."""
    hidden = file.create_dataset("hidden", shape=(8, 1), dtype="f8", external=[(str(other), 0, 64)])
    cell = file.create_dataset("stolen", (1, 1), dtype=h5py.ref_dtype)
    cell[0, 0] = hidden.ref
    cell.attrs["MATLAB_class"] = np.bytes_("cell")
    h5py.h5o.link(hidden.id, file.create_group("keep").id, b"x")
    del file["hidden"], file["keep/x"]
    # The count of links is 0 now; what is left of the object can still be reached while the file is open.
    file["#refs#/other"] = 1.0


def by_reference_in_refs(file: h5py.File, other: Path) -> None:
    hidden = file.create_dataset("#refs#/zz", shape=(8, 1), dtype="f8", external=[(str(other), 0, 64)])
    cell = file.create_dataset("stolen", (1, 1), dtype=h5py.ref_dtype)
    cell[0, 0] = hidden.ref
    cell.attrs["MATLAB_class"] = np.bytes_("cell")


ATTACKS: dict[str, tuple[Callable[[h5py.File, Path], None], str]] = {
    "external link": (external_link, "'stolen' is a link to another file"),
    "external link within": (external_link_within, "'log/a/b/c/stolen' is a link to another file"),
    "external storage": (external_storage, "'stolen' is an array in external storage"),
    "virtual": (virtual, "'stolen' is a virtual data set"),
    "virtual without end": (virtual_without_end, "'stolen' is a virtual data set"),
    "soft link to itself": (soft_link_to_itself, "'stolen' is a soft link"),
    "soft link": (soft_link, "'g/out' is a soft link"),
    "by reference": (by_reference_in_refs, "'stolen .reference.' is an array in external storage"),
}


@pytest.fixture
def limited():
    """A hang fails the test."""
    signal.alarm(60)
    yield
    signal.alarm(0)


@pytest.mark.parametrize("attack", ATTACKS)
@pytest.mark.parametrize("kind", ["file", "pipe", "missing"])
def test_a_mat_file_reads_no_other_file(tmp_path, limited, attack, kind):
    path, other = log_in(tmp_path), tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["data"] = SECRET
    build, message = ATTACKS[attack]
    with h5py.File(path, "r+") as file:
        if attack == "external link within":
            del file["log"]
        build(file, other)
    if kind != "file":
        other.unlink()
    if kind == "pipe":
        os.mkfifo(other)
    with pytest.raises(DataError, match=message):
        check_size(path)
    with pytest.raises(DataError, match=message):
        read_recording(path)


def test_an_array_that_only_a_reference_leads_to_is_looked_at(tmp_path):
    path = log_in(tmp_path)
    with h5py.File(path, "r+") as file:
        layout = h5py.VirtualLayout(shape=(8, 1), dtype="f8")
        layout[:, 0] = h5py.VirtualSource("elsewhere.h5", "data", shape=(8,))
        hidden = file.create_virtual_dataset("hidden", layout)
        cell = file.create_dataset("cell", (1, 1), dtype=h5py.ref_dtype)
        cell[0, 0] = hidden.ref
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
        # The link goes to another group that is cut off from the tree by overwriting its name below.
        file.create_group("gone")["hidden"] = hidden
        del file["hidden"]
        address = h5py.h5o.get_info(hidden.id).addr
    data = path.read_bytes()
    # The group's only link is made to lead to the root group instead, so that nothing but the cell names the array.
    place = data.rindex(address.to_bytes(8, "little"))
    with h5py.File(path) as file:
        root = h5py.h5o.get_info(file.id).addr
    assert place > 0
    for start in [i for i in range(len(data)) if data.startswith(address.to_bytes(8, "little"), i)]:
        changed = bytearray(data)
        changed[start : start + 8] = root.to_bytes(8, "little")
        path.write_bytes(changed)
        with h5py.File(path) as file:
            if isinstance(file.get("gone/hidden"), h5py.Group) and file[file["cell"][0, 0]].name != "/":
                break
    with pytest.raises(DataError, match=r"'cell \(reference\)' is a virtual data set"):
        check_size(path)


@pytest.mark.parametrize("rows", [1 << 28, 1 << 40])
def test_bombs_are_refused_by_what_they_claim(tmp_path, rows):
    path = log_in(tmp_path)
    with h5py.File(path, "r+") as file:
        file.create_dataset("bomb", shape=(rows, 1), chunks=(1 << 20, 1), dtype="f8", compression="gzip")
        file["bomb"][:8] = 1.0
    with pytest.raises(DataError, match="'bomb' claims"):
        read_recording(path)


def test_a_filter_that_is_loaded_as_code_is_refused(tmp_path):
    path = log_in(tmp_path)
    with h5py.File(path, "r+") as file:
        file.create_dataset("odd", data=np.zeros(100), chunks=(100,), compression="lzf")
    with pytest.raises(DataError, match="'odd' is an array packed by the filter 32000"):
        read_recording(path)


def test_groups_within_themselves_and_deep_ones_end(tmp_path, limited):
    path = log_in(tmp_path)
    with h5py.File(path, "r+") as file:
        group = file.create_group("deep")
        for _ in range(300):
            group = group.create_group("g")
        group["back"] = file["deep"]
    check_size(path)
    with pytest.raises(DataError) as refused:
        read_recording(path)
    assert len(str(refused.value)) < 1000


def test_what_matlab_writes_is_read(tmp_path):
    for layout in ("struct", "timeseries", "dataset", "timetable", "simulink"):
        values = np.arange(200, dtype=np.float32).reshape(100, 2)
        recording = Recording("R", (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"]), values, 100.0)
        path = write_recording(recording, tmp_path / f"{layout}.mat", WriteOptions(layout, "v7.3"))
        np.testing.assert_array_equal(read_recording(path).values, values)
