"""Every log is read in a process of its own that may read this log and nothing else, write nothing, and not last."""

from __future__ import annotations

import gc
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import FORMATS, open_log, read_recording, write_recording
from edp.recording import Recording
from edp.sandbox import end, sandbox, watch
from edp.signals import TABLE_A1, Channel, Kind, SignalMap

LINUX = sys.platform.startswith("linux") and platform.machine() in ("x86_64", "aarch64")
linux = pytest.mark.skipif(not LINUX, reason="the kernel's layers are Linux's")
HERE = Path(__file__).parent
SUFFIXES = [part.suffixes[0] for part in FORMATS.values()]


def recording(samples=200):
    channels = (*(TABLE_A1[name] for name in ("BmUp", "CylVels_1")), Channel("Extra", Kind.GENERIC))
    values = np.random.default_rng(0).standard_normal((samples, 3)).astype(np.float32)
    return Recording("R1", channels, values, 100.0, "sim:sandbox", {"seed": 1})


@pytest.fixture
def hostile(tmp_path, monkeypatch, hostile_worker):
    """Writes a file that makes its reader do something."""
    monkeypatch.setitem(FORMATS._parts, "hostile", hostile_worker)

    def write(deed, argument="", when="open"):
        path = tmp_path / "x.hostile"
        path.write_text(f"{deed}|{argument}|{when}")
        return path

    return write


def running(pid):
    """Whether a process runs (one that has ended and waits to be asked about does not)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    # It may end between the opening of the file and its reading.
    except (FileNotFoundError, ProcessLookupError):
        return False


def gone(pid):
    """Wait until a process has ended; False after a long time."""
    for _ in range(3000):
        if not running(pid):
            return True
        time.sleep(0.01)
    return False


def children_of(pid):
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def descendants(pid):
    return [one for child in children_of(pid) for one in (child, *descendants(child))]


_hearing = []


@cache  # a hook cannot be removed, and each one costs every later test of this process
def _install_hook():
    sys.addaudithook(
        lambda event, arguments, hearing=_hearing: [hear(event, arguments) for hear in hearing] if hearing else None
    )


@contextmanager
def heard(note):
    """Every event of Python goes to `note`."""
    _install_hook()
    _hearing.append(note)
    try:
        yield
    finally:
        _hearing.clear()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_this_process_opens_no_log_but_for_its_first_bytes(tmp_path, suffix, monkeypatch):
    path = write_recording(recording(), tmp_path / f"a{suffix}")
    opened = []

    def note(event, arguments):
        if event in ("open", "sqlite3.connect") and str(arguments[0]).endswith(path.name):
            opened.append(event)

    for part in set(map(type, FORMATS.values())):
        monkeypatch.setattr(part, "read", lambda *_: pytest.fail("read in this process"))
    with heard(note):
        read = read_recording(path)
    assert opened == ["open"] * 2 or opened == ["open"]  # os.open, and the stream made of it
    names = ["BmUp", "CylVels_1"] if suffix == ".csv" else ["BmUp", "CylVels_1", "Extra"]
    assert sorted(read.channel_names) == names
    np.testing.assert_array_equal(read.select(names), recording().select(names))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_log_and_what_its_format_reads_itself_are_the_same(tmp_path, suffix):
    path = write_recording(recording(), tmp_path / f"a{suffix}")
    apart, here = (
        open_log(path, SignalMap()),
        FORMATS[next(part.name for part in FORMATS.values() if suffix in part.suffixes)].read(path, SignalMap()),
    )
    assert list(apart.signals) == list(here.signals)
    for mine, theirs in zip(apart.signals.values(), here.signals.values()):
        about = [(s.name, s.samples, s.unit, s.kind, s.description, s.key, s.table is None) for s in (mine, theirs)]
        assert about[0] == about[1]
        assert mine.values.tobytes() == theirs.values.tobytes()
        assert (mine.time_s is None) == (theirs.time_s is None)
        if mine.time_s is not None:
            assert mine.time_s.tobytes() == theirs.time_s.tobytes()
        for start, stop in ((0, 200), (13, 57)):
            pieces = [[np.concatenate(c) for c in zip(*s.table.pieces([s.key], start, stop))] for s in (mine, theirs)]
            assert pieces[0][0].dtype == pieces[1][0].dtype
            assert pieces[0][0].tobytes() == pieces[1][0].tobytes()
    for name in ("scalars", "rate_hz", "name", "source", "meta", "aliases", "digest"):
        assert getattr(apart, name) == getattr(here, name)
    assert {key: list(full) for key, full in apart.repeated.items()} == {k: list(f) for k, f in here.repeated.items()}


def test_columns_share_their_time_and_pieces_may_be_left_and_mixed(tmp_path):
    path = write_recording(recording(300_000), tmp_path / "a.csv")
    raw = open_log(path, SignalMap())
    first, second = raw.signals["BmUp"], raw.signals["CylVels_1"]
    assert first.time_s is second.time_s
    whole = first.values, second.values
    one, other = (s.table.pieces([s.key], 0, s.samples) for s in (first, second))
    parts = [[], []]
    for a, b in zip(one, other):
        parts[0].append(a[0])
        parts[1].append(b[0])
        next(first.table.pieces([second.key], 5, 300_000))  # left after one piece
    for joined, wanted in zip(parts, whole):
        np.testing.assert_array_equal(np.concatenate(joined), wanted)


@linux
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_reader_of_every_format_is_locked_in(tmp_path, suffix):
    raw = open_log(write_recording(recording(), tmp_path / f"a{suffix}"), SignalMap())
    worker = sandbox._workers["edp.logs.sandbox_worker"].process.pid
    (reader,) = children_of(worker)[-1:]
    status = dict(
        line.split(":\t", 1) for line in Path(f"/proc/{reader}/status").read_text().splitlines() if ":\t" in line
    )
    assert (status["Seccomp"], status["NoNewPrivs"]) == ("2", "1")
    bounds = Path(f"/proc/{reader}/limits").read_text()
    for name in ("Max file size", "Max core file size"):
        assert next(line for line in bounds.splitlines() if line.startswith(name)).split()[-3:-1] == ["0", "0"]
    data = next(line for line in bounds.splitlines() if line.startswith("Max data size")).split()[3]
    assert int(data) < 4 << 30
    handles = [os.readlink(entry) for entry in Path(f"/proc/{reader}/fd").iterdir()]
    assert not [name for name in handles if name.startswith("socket:")]
    del raw
    gc.collect()
    assert gone(reader)


@linux
@pytest.mark.parametrize("when", ["open", "load"])
@pytest.mark.parametrize(
    ("deed", "argument"),
    [
        ("socket", ""), ("socket in C", ""), ("program", "MARK"), ("system", "MARK"), ("program in C", ""),
        ("fork", ""), ("fork in C", ""), ("read", "/etc/passwd"), ("read in C", "/etc/passwd"), ("read", "OTHER"),
        ("read in C", "OTHER"), ("write", "MARK"), ("write in C", "MARK"), ("write", "OTHER"), ("write in C", "OTHER"),
        ("write", "LOG"), ("write in C", "LOG"), ("remove", "OTHER"), ("remove in C", "OTHER"), ("mode in C", "OTHER"),
        ("signal", "PID"), ("signal in C", "PID"), ("trace in C", "PID"), ("unpickle", ""),
    ],
)  # fmt: skip
def test_what_no_reader_needs_is_refused(hostile, tmp_path, deed, argument, when):
    mark, other, log = tmp_path / "mark", tmp_path / "other.csv", tmp_path / "x.hostile"
    other.write_text("secret")
    other.chmod(0o600)
    places = {"MARK": str(mark), "OTHER": str(other), "LOG": str(log), "PID": str(os.getpid())}
    path = hostile(deed, places.get(argument, argument), when)
    before = path.read_bytes()
    with pytest.raises(DataError, match=r"x.hostile' cannot be read .*(may not|not permitted|ermission denied)"):
        read_recording(path)
    assert not mark.exists()
    assert (other.read_text(), other.stat().st_mode & 0o777, path.read_bytes()) == ("secret", 0o600, before)


@linux
def test_all_layers_hold_here_and_threads_still_run(hostile):
    with pytest.raises(DataError, match="file rules and system-call filter and limits and audit hook"):
        read_recording(hostile("layers"))
    with pytest.raises(DataError, match="4 threads ran"):
        read_recording(hostile("threads"))


@pytest.mark.parametrize(
    ("deed", "argument", "message"),
    [
        ("crash", int(signal.SIGSEGV), r"its library crashes on it \(signal 11\)"),
        ("crash", int(signal.SIGABRT), r"its library crashes on it \(signal 6\)"),
        ("crash", int(signal.SIGKILL), r"mostly for lack of memory"),
        ("exit", 3, r"the process that reads logs failed .exit code 3"),
        ("exit", 0, r"the process that reads logs failed .exit code 0"),
        ("fail", "name", r"cannot be read .KeyError: 'name'"),
        ("recursion", "", r"cannot be read .RecursionError"),
        ("allocate", 3000, r"reading it takes more than 0.537 GB of memory, the limit for a file of \d+ bytes"),
        # More than a small file may have, and little enough that a busy machine fills it within the processor time.
        ("announce", 700, r"700 MB were had|machine has free"),
    ],
)
@pytest.mark.parametrize("when", ["open", "load"])
def test_whatever_a_file_does_to_its_library_is_one_error(hostile, tmp_path, deed, argument, message, when):
    sound = write_recording(recording(), tmp_path / "sound.parquet")
    with pytest.raises(DataError, match=f"x.hostile'.*(?:{message})"):
        read_recording(hostile(deed, argument, when))
    assert read_recording(sound).digest == recording().digest


@pytest.fixture
def impatient(monkeypatch):
    """Readers get less time."""
    end()
    monkeypatch.setenv("EDP_TEST_START_S", "0.2")
    yield
    end()


def test_a_reader_that_finds_no_end_is_ended(hostile, impatient):
    for deed in ("loop", "wait"):
        for when in ("open", "load"):
            with pytest.raises(DataError, match="it takes more processor time than"):
                read_recording(hostile(deed, "", when))


def test_low_memory_is_not_told_as_damage(hostile):
    code = (
        "import resource, sys\n"
        "from edp.errors import DataError\n"
        "import hostile_format\n"
        "from edp.logs import read_recording\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (450 << 20),) * 2)\n"
        "try:\n    read_recording(sys.argv[1])\nexcept DataError as error:\n    print(error)\n"
    )
    path = hostile("allocate", 3000)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *filter(None, sys.path)])}
    done = subprocess.run([sys.executable, "-c", code, str(path)], env=environment, capture_output=True, text=True)
    assert "machine has free" in done.stdout
    assert "damaged" not in done.stdout
    assert done.stderr == ""


def heed_interrupts() -> None:
    """In a new process: a shell starts what runs in its background with Ctrl-C ignored, and children inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@linux
def test_readers_end_with_whoever_asked(tmp_path):
    path = write_recording(recording(300_000), tmp_path / "a.parquet")
    code = (
        "import sys, time\nfrom edp.logs import open_log\nfrom edp.signals import SignalMap\n"
        "raw = open_log(sys.argv[1], SignalMap())\nprint('open', flush=True)\ntime.sleep(600)\n"
    )
    for how in (signal.SIGKILL, signal.SIGINT):
        command = [sys.executable, "-c", code, str(path)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        asking = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, preexec_fn=heed_interrupts
        )
        assert asking.stdout.readline() == b"open\n"
        started = descendants(asking.pid)
        assert len(started) == 2  # the worker and the reader
        asking.send_signal(how)
        asking.wait()
        asking.stdout.close()
        assert all(map(gone, started))


@linux
def test_readers_end_with_their_worker_and_the_next_log_gets_another(tmp_path):
    path = write_recording(recording(), tmp_path / "a.parquet")
    raw = open_log(path, SignalMap())
    worker = sandbox._workers["edp.logs.sandbox_worker"].process
    readers = children_of(worker.pid)
    worker.kill()
    assert all(map(gone, readers))
    with pytest.raises(DataError, match=r"a\.parquet' cannot be read"):
        raw.signals["BmUp"].load()
    with pytest.raises(DataError, match="open it again"):
        raw.signals["BmUp"].load()
    assert read_recording(path).digest == recording().digest


@linux
def test_logs_one_after_the_other_leave_nothing_behind(tmp_path):
    path = write_recording(recording(), tmp_path / "a.parquet")
    read_recording(path)
    before = len(os.listdir("/proc/self/fd"))
    worker = sandbox._workers["edp.logs.sandbox_worker"].process.pid
    in_worker = len(os.listdir(f"/proc/{worker}/fd"))
    for _ in range(40):
        read_recording(path)
    assert len(os.listdir("/proc/self/fd")) == before
    for _ in range(3000):
        if not children_of(worker) and len(os.listdir(f"/proc/{worker}/fd")) <= in_worker:
            break
        time.sleep(0.01)
    assert children_of(worker) == []
    assert len(os.listdir(f"/proc/{worker}/fd")) <= in_worker


def test_many_logs_are_open_at_once_and_threads_take_turns(tmp_path):
    path = write_recording(recording(), tmp_path / "a.mcap")
    logs = [open_log(path, SignalMap()) for _ in range(20)]
    want = logs[0].signals["BmUp"].values
    found = []
    threads = [threading.Thread(target=lambda log=log: found.append(log.signals["BmUp"].values)) for log in logs]
    threads += [threading.Thread(target=lambda: found.append(logs[0].signals["BmUp"].values)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 28
    assert all(np.array_equal(values, want) for values in found)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes fork on POSIX only")
@pytest.mark.filterwarnings("ignore:This process")
def test_a_fork_of_the_reading_process_has_a_worker_of_its_own(tmp_path):
    path = write_recording(recording(), tmp_path / "a.parquet")
    raw = open_log(path, SignalMap())
    mine = sandbox._workers["edp.logs.sandbox_worker"].process.pid
    child = os.fork()
    if child == 0:
        same = False
        try:
            same = read_recording(path).digest == recording().digest
            same = same and sandbox._workers["edp.logs.sandbox_worker"].process.pid != mine
            try:
                raw.signals["BmUp"].load()
                same = False
            except DataError as error:
                same = same and "before this process was forked" in str(error)
            end()
        finally:
            os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert len(raw.signals["BmUp"].load()) == 200
    assert sandbox._workers["edp.logs.sandbox_worker"].process.pid == mine


def test_an_interrupted_log_says_so_and_others_are_read(tmp_path, monkeypatch):
    path = write_recording(recording(), tmp_path / "a.parquet")
    raw = open_log(path, SignalMap())

    def interrupt(view):
        raise KeyboardInterrupt

    channel = raw.signals["BmUp"].table.log.channel
    monkeypatch.setattr(channel, "_read_into", interrupt)
    with pytest.raises(KeyboardInterrupt):
        raw.signals["BmUp"].load()
    with pytest.raises(DataError, match="interrupted; open it again"):
        raw.signals["BmUp"].load()
    assert read_recording(path).samples == 200


def test_where_processes_cannot_fork_each_log_has_an_interpreter(tmp_path, monkeypatch):
    path = write_recording(recording(), tmp_path / "a.parquet")
    monkeypatch.setattr(sandbox, "_FORKS", False)
    assert read_recording(path).digest == recording().digest
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(DataError, match="end is missing"):
        read_recording(path)


def test_paths_are_those_of_the_asking_process(tmp_path, monkeypatch):
    path = write_recording(recording(), tmp_path / "a.mat")
    monkeypatch.chdir(tmp_path)
    assert read_recording("a.mat").samples == 200
    Path("a.mat").write_bytes(path.read_bytes()[:300])
    with pytest.raises(DataError, match=r"^'a.mat' is a MAT file that is cut off"):
        read_recording("a.mat")


def test_a_watcher_hears_of_slow_logs_only(hostile, impatient, monkeypatch):
    heard = []
    watch(lambda *told: heard.append(told))
    monkeypatch.setattr(sandbox, "SLOW_S", 1e9)
    try:
        with pytest.raises(DataError):
            read_recording(hostile("wait"))
        assert heard == []
        monkeypatch.setattr(sandbox, "SLOW_S", 0.5)
        with pytest.raises(DataError):
            read_recording(path := hostile("wait"))
    finally:
        watch(None)
    assert heard[0][0] == path
    assert heard[0][1] > 0.5
    assert heard[0][2] == path.stat().st_size


@pytest.mark.parametrize(
    "pauses",
    [
        pytest.param(np.linspace(0.01, 0.03, 9), id="nine"),
        pytest.param(np.linspace(0.0, 0.06, 25), id="many", marks=pytest.mark.slow),
    ],
)
def test_a_worker_that_ends_for_want_of_work_loses_no_order(pauses, tmp_path, monkeypatch):
    """Orders that arrive while an idle worker ends are obeyed, or refused so that another worker starts."""
    module = tmp_path / "hasty_worker.py"
    module.write_text(
        "import edp.sandbox.sandbox_worker as worker\n"
        "worker.IDLE_S = 0.02\n"
        "from edp.logs.served import serve\n"
        "if __name__ == '__main__':\n"
        "    worker.main(serve)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("edp.logs.sandboxed.WORKER", "hasty_worker")
    log = tmp_path / "log.csv"
    log.write_text("time,CylVels_1\n" + "\n".join(f"{tick / 100},{tick % 7}" for tick in range(50)) + "\n")
    for pause in pauses:  # around the time after which the worker ends
        time.sleep(pause)
        assert read_recording(log).samples == 50
