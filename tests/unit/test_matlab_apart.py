"""MAT files are unpacked in a process of its own, which a damaged file may crash, hang or fill."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.errors import DataError
from edp.logs import WriteOptions, read_recording, write_recording
from edp.matlab import apart, end, unpack
from edp.matlab.child import open_file
from edp.recording import Recording
from edp.signals import Channel, Kind

PLAIN = """
import os, signal, sys
from edp.matlab import child
{}
child.main()
"""


@pytest.fixture
def log(tmp_path):
    values = np.arange(60, dtype=np.float32).reshape(20, 3)
    channels = tuple(Channel(name, Kind.GENERIC) for name in "abc")
    return write_recording(Recording("r", channels, values, 100.0), tmp_path / "a.mat")


@pytest.fixture
def helper(monkeypatch):
    """Starts helper processes in which a line of code has been run first."""

    def use(line):
        end()
        monkeypatch.setattr(apart, "_CHILD", ("-P", "-c", PLAIN.format(line)))

    yield use
    end()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", r"its library crashes on it \(signal 11\)"),
        ("os.kill(os.getpid(), signal.SIGBUS)", r"its library crashes on it \(signal 7\)"),
        ("[None for k in iter(int, 1)]", "its library finds no end in it"),
        ("bytearray(1 << 30)", "cannot be read as a MAT file .MemoryError"),
        ("os._exit(3)", "the process that reads MAT files failed .exit code 3"),
        ("{b'x': 1}", "whose name is no text"),
    ],
)
def test_whatever_a_file_does_to_its_library_is_one_error(log, helper, fault, message):
    helper(f"child.START_S = 0.3; child.matio.load_from_mat = lambda *_, **__: {fault}")
    for _ in range(2):
        with pytest.raises(DataError, match=f"a.mat'.*{message}"):
            read_recording(log)


def test_the_file_after_a_crash_is_read(log, helper, tmp_path):
    helper(
        "load = child.matio.load_from_mat\n"
        "child.matio.load_from_mat = lambda path, **more: "
        "os.kill(os.getpid(), signal.SIGSEGV) if 'bad' in path else load(path, **more)"
    )
    (tmp_path / "bad.mat").write_bytes(log.read_bytes())
    for _ in range(2):
        with pytest.raises(DataError, match="crashes on it"):
            read_recording(tmp_path / "bad.mat")
        assert read_recording(log).samples == 20


def test_a_helper_that_ended_by_itself_or_was_killed_is_replaced(log, helper):
    helper("child.IDLE_S = 0.05")
    read_recording(log)
    time.sleep(0.3)
    read_recording(log)
    read_recording(log)
    apart._helper.process.kill()
    time.sleep(0.05)
    assert read_recording(log).samples == 20


def test_a_helper_that_never_starts_is_an_error(log, helper):
    helper("raise ImportError('no such library')")
    with pytest.raises(DataError, match=r"failed \(ImportError: no such library\)"):
        read_recording(log)


def test_threads_take_turns(log):
    found = []
    threads = [threading.Thread(target=lambda: found.append(read_recording(log).digest)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [read_recording(log).digest] * 8


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes fork on POSIX only")
@pytest.mark.filterwarnings("ignore:This process")
def test_a_fork_of_the_reading_process_has_a_helper_of_its_own(log):
    whole = read_recording(log).digest
    mine = apart._helper.process.pid
    child = os.fork()
    if child == 0:
        same = False
        try:
            same = read_recording(log).digest == whole and apart._helper.process.pid != mine
            end()
        finally:
            os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert read_recording(log).digest == whole
    assert apart._helper.process.pid == mine


def test_paths_are_those_of_the_asking_process(log, monkeypatch):
    read_recording(log)
    monkeypatch.chdir(log.parent)
    assert read_recording("a.mat").samples == 20
    Path("a.mat").write_bytes(log.read_bytes()[:300])
    with pytest.raises(DataError, match=r"^'a.mat' is a MAT file that is cut off"):
        read_recording("a.mat")


@pytest.mark.parametrize("version", ["v5", "v7.3"])
def test_the_same_is_found_in_this_process_and_apart(tmp_path, version):
    stamps = np.arange(9.0)
    channels = (Channel("u", Kind.GENERIC), Channel("v", Kind.GENERIC))
    recording = Recording("r", channels, np.arange(18, dtype=np.float32).reshape(9, 2), 100.0)
    own = write_recording(recording, tmp_path / "own.mat", WriteOptions("dataset", version))
    scipy.io.savemat(
        tmp_path / "foreign.mat",
        {
            "t": stamps,
            "big": stamps.astype(">f8"),
            "flag": stamps > 3,
            "few": stamps.astype(np.int16),
            "m": np.ones((9, 2), np.uint8),
            "gain": float("nan"),
            "s": {"time": stamps, "t2": 2 * stamps},
            "empty": np.empty((0, 0)),
        },
    )
    for path in (own, tmp_path / "foreign.mat"):
        here, apart_ = open_file(path, None), unpack(path)
        assert [(p.name, p.unit) for p in here.signals] == [(p.name, p.unit) for p in apart_.signals]
        for mine, theirs in zip(here.signals, apart_.signals):
            assert mine.values.dtype == theirs.values.dtype
            np.testing.assert_array_equal(mine.values, theirs.values)
            assert (mine.time is None) == (theirs.time is None)
            if mine.time is not None:
                np.testing.assert_array_equal(mine.time, theirs.time)
        assert str(here.scalars) == str(apart_.scalars)
        assert (here.repeated, here.names, here.info) == (apart_.repeated, apart_.names, apart_.info)


def test_limits_grow_with_what_a_file_holds(tmp_path):
    columns = {f"c{k}": np.zeros((1000, 1)) for k in range(30)}
    told = {}
    for count in (1, 30):
        path = tmp_path / f"{count}.mat"
        scipy.io.savemat(path, dict(list(columns.items())[:count]))
        told[count] = []
        open_file(path, None, lambda *limits, count=count: told[count].append(limits))
    (walk, load), (long_walk, long_load) = told[1], told[30]
    assert long_walk[0] > walk[0]
    assert long_load[0] > load[0]
    assert long_load[1] - load[1] > 29 * 8000 * 8


def test_equal_times_are_one_array(tmp_path):
    channels = (Channel("u", Kind.GENERIC), Channel("v", Kind.GENERIC))
    recording = Recording("r", channels, np.zeros((9, 2), np.float32), 100.0)
    found = unpack(write_recording(recording, tmp_path / "a.mat", WriteOptions("dataset")))
    times = [part.time for part in found.signals]
    assert len(times) == 2
    assert times[0] is times[1]
