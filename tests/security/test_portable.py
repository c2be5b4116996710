"""Windows has no fcntl, resource, fork or O_NOFOLLOW: modules import without them, and its locks keep their promises.

Nothing here runs on Windows: what it lacks is hidden, and its lock is called through a stand-in with its rules.
"""

import errno
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from edp.storage.portable import lock_region

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
