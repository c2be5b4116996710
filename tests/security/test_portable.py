"""Windows has no fcntl, resource, fork or O_NOFOLLOW: modules import without them, and its locks keep their promises.

Nothing here runs on Windows: what it lacks is hidden, and its lock is called through a stand-in with its rules.
"""

import ast
import asyncio
import errno
import os
import platform
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import edp
from edp.cli.doctor import machine
from edp.storage.portable import lock_region
from edp.workflows.live.serve_live import _interrupts

HIDE = """
import importlib, os, pathlib, sys

ROOMS = tuple(sys.argv[1:])
HIDDEN = {"fcntl", "resource", "pwd", "grp", "termios", "pty"}


class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name in HIDDEN and asked_by_edp():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def asked_by_edp():
    frame = sys._getframe(2)
    while frame and "importlib" in frame.f_code.co_filename:
        frame = frame.f_back
    return bool(frame) and (os.sep + "edp" + os.sep) in frame.f_code.co_filename


def modules():
    import edp

    top = pathlib.Path(edp.__file__).parent
    for path in sorted(top.rglob("*.py")):
        name = ".".join(("edp", *path.relative_to(top).with_suffix("").parts)).removesuffix(".__init__")
        if name.startswith(ROOMS) and ".ros2.package" not in name and not name.endswith("__main__"):
            yield name


for name in modules():  # libraries have Windows builds of their own: they are loaded as they are here
    importlib.import_module(name)
for name in [name for name in sys.modules if name.partition(".")[0] == "edp" or name in HIDDEN]:
    del sys.modules[name]
sys.meta_path.insert(0, Hidden())
LACKS = ("O_NOFOLLOW", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "fork", "uname", "sysconf", "register_at_fork",
         "sched_getaffinity", "killpg", "getuid", "geteuid")
for name in LACKS:
    if hasattr(os, name):
        delattr(os, name)
sys.platform = "win32"
sys.modules["msvcrt"] = __import__("types").ModuleType("msvcrt")
for name in modules():
    try:
        importlib.import_module(name)
    except Exception as error:
        print(f"{name}: {error!r}")
"""
"""Left out: the part of the ROS 2 package that runs inside ROS only."""


@pytest.mark.processes
@pytest.mark.parametrize(
    "rooms", [("edp.storage", "edp.sandbox", "edp.cli"), pytest.param(("edp.",), marks=pytest.mark.slow)]
)
def test_modules_import_without_what_windows_lacks(rooms):
    done = subprocess.run(
        [sys.executable, "-c", HIDE, *rooms], capture_output=True, text=True, timeout=280, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == ""


class Msvcrt(SimpleNamespace):
    """Locks bytes of files as Windows does: one holder a byte, whichever handle asks."""

    LK_LOCK, LK_NBLCK = 1, 2

    def __init__(self):
        super().__init__(held={}, calls=0)

    def locking(self, handle, mode, count):
        place = os.lseek(handle, 0, os.SEEK_CUR)
        key = (os.fstat(handle).st_ino, place)
        self.calls += 1
        if self.held.setdefault(key, handle) != handle:
            if mode == self.LK_LOCK and self.calls > 3:
                del self.held[key]  # the other holder went away meanwhile
            raise OSError(errno.EDEADLK if mode == self.LK_LOCK else errno.EACCES, "held")


def test_the_lock_of_windows_is_one_byte_behind_the_content(tmp_path):
    windows, path = Msvcrt(), tmp_path / "lock"
    path.write_text("7 on host")
    with path.open("r+") as first, path.open("r+") as second:
        first.seek(3)
        lock_region(windows, first, wait=False)
        assert os.lseek(first.fileno(), 0, os.SEEK_CUR) == 3
        (key,) = windows.held
        assert key[1] > 10**9  # so that others may read who holds it
        with pytest.raises(OSError, match="held"):
            lock_region(windows, second, wait=False)
        lock_region(windows, second, wait=True)  # tries until it is free
    assert path.read_text() == "7 on host"


LACKING = {
    "os": {
        *("fork", "forkpty", "killpg", "getpgid", "setsid", "getuid", "geteuid", "uname", "sysconf", "nice", "sync"),
        *("register_at_fork", "sched_getaffinity", "waitid", "WNOHANG", "getloadavg", "mkfifo", "chown", "fchown"),
        *("fchmod", "pread", "pwrite", "posix_spawn", "statvfs", "memfd_create", "O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC"),
        *("O_NOFOLLOW", "O_DIRECTORY", "O_PATH"),
    },
    "signal": {
        *("SIGKILL", "SIGALRM", "SIGPROF", "SIGXCPU", "SIGCHLD", "SIGHUP", "SIGPIPE", "SIGUSR1", "setitimer", "alarm"),
        *("getitimer", "ITIMER_PROF", "ITIMER_REAL", "pthread_sigmask", "sigwait"),
    },
    "socket": {"send_fds", "recv_fds", "AF_UNIX", "SO_REUSEPORT"},
    "select": {"poll", "epoll", "POLLIN", "POLLHUP", "POLLERR", "POLLNVAL"},
    "time": {"tzset"},
}
"""Attributes that Python has on POSIX only."""
MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "pty", "tty", "syslog"}
GUARDED = {
    "cli/doctor.py": "hasattr",
    "data/screening/compiled.py": "hasattr",
    "sandbox/allowance.py": "an import that may fail, hasattr, and /proc, which is read first",
    "sandbox/broker.py": "Linux only, by sys.platform",
    "sandbox/landlock.py": "Linux only, by sys.platform",
    "sandbox/lockdown.py": "an import that may fail",
    "sandbox/processes.py": "Linux only, by sys.platform",
    "sandbox/sandbox.py": "hasattr; without forks a log has a process of its own",
    "sandbox/sandbox_worker.py": "the worker that forks, which is not started without forks",
    "storage/memory.py": "an import that may fail, and suppressed",
    "storage/portable.py": "sys.platform, and hasattr",
    "jobs/perform.py": "an import that may fail",
    "jobs/processes.py": "refused on win32 before a process is started",
}
"""Where they are used, and what keeps Windows from them."""


def test_what_only_posix_has_is_used_where_something_keeps_windows_from_it():
    top = Path(edp.__file__).parent
    using = set()
    for path in top.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                names += ["resource"] if node.attr in LACKING.get(node.value.id, ()) else []
            if MODULES & set(names):
                using.add(path.relative_to(top).as_posix())
    assert using == set(GUARDED)


WITHOUT = """
import os, select, signal, socket

for module, names in {
    os: ("fork", "forkpty", "register_at_fork", "killpg", "sched_getaffinity"),
    select: ("poll", "epoll"),
    signal: ("setitimer", "getitimer", "alarm"),
    socket: ("send_fds", "recv_fds"),
}.items():
    for name in names:
        vars(module).pop(name, None)
"""
"""Of `LACKING`, what Python's own libraries can do without on this system."""


@pytest.mark.processes
def test_a_log_is_read_and_a_file_written_and_held_without_forks_timers_and_polls(tmp_path):
    # The process that reads the log is a child: both begin with what Windows lacks taken away.
    (tmp_path / "sitecustomize.py").write_text(WITHOUT, encoding="utf-8")
    (tmp_path / "log.csv").write_text("t,speed\n" + "".join(f"{n / 100},{n}\n" for n in range(50)), encoding="utf-8")
    code = (
        "import os, edp\nfrom edp.storage import hold, release, write_json\n"
        "assert not hasattr(os, 'fork')\n"
        "print(edp.read('log.csv')[0].samples)\n"
        "write_json('a.json', {})\nrelease('lock', hold('lock'))"
    )
    places = os.pathsep.join([str(tmp_path), *(place for place in sys.path if place)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": places},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("50\n", 0), done.stderr[-2000:]


def test_a_live_session_is_ended_by_ctrl_c_where_loops_take_no_signals(monkeypatch):
    async def session() -> bool:
        loop, stop = asyncio.get_running_loop(), asyncio.Event()

        def lacks(*_):
            raise NotImplementedError

        monkeypatch.setattr(loop, "add_signal_handler", lacks)
        monkeypatch.setattr(loop, "remove_signal_handler", lacks)
        with _interrupts(stop):
            signal.raise_signal(signal.SIGINT)
            await asyncio.wait_for(stop.wait(), 10)
        return stop.is_set()

    before = signal.getsignal(signal.SIGINT)
    assert asyncio.run(session())
    assert signal.getsignal(signal.SIGINT) is before


def test_doctor_says_on_windows_that_only_linux_is_tested_and_does_not_call_it_broken(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    (check,) = [check for check in machine(tmp_path) if check.what == "system"]
    assert check.state == "missing"
    assert "WSL" in check.needed_for
