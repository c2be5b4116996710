"""Reads every file of a folder with its own reader, in this process, and tells what Python did meanwhile.

``python trace_worker.py FOLDER``: files named ``honest*`` are read first, untraced, so that libraries are imported and
have made what they make once. A JSON object follows on the last line: events by file, and how each read ended.
"""

from __future__ import annotations

import json
import os
import sys
import sysconfig
from pathlib import Path

import edp
from edp.config.experiment import load_experiment
from edp.errors import EdpError
from edp.logs.detect import format_for
from edp.logs.formats.base import FORMATS
from edp.logs.served import keep_temporary_files_in_memory
from edp.logs.source import load_signal_map
from edp.registry import load_plugins
from edp.signals import SignalMap
from edp.sim import Snapshot
from edp.training import load_bundle

RUNS = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "pty.spawn")
NETWORK = ("socket.", "urllib.", "http.", "ftplib.", "smtplib.")
CHANGES = (
    "os.remove",
    "os.rename",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.chmod",
    "os.chown",
    "os.truncate",
)
LIBRARIES = tuple(
    {os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    | {
        os.path.dirname(os.path.realpath(edp.__file__)),
        "/usr/share/zoneinfo",
        f"/proc/{os.getpid()}",  # what /proc/self leads to: free memory is asked for before it is taken
        "/proc/meminfo",
        "/sys/fs/cgroup",
    }
)
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Trace:
    """Events that no reading of data needs."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.armed, self.seen = os.path.realpath(folder), False, list[str]()
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple[object, ...]) -> None:
        if self.armed and (what := self.finding(event, arguments)):
            self.seen.append(f"{event}: {what}"[:300])

    def finding(self, event: str, arguments: tuple[object, ...]) -> str:
        if event == "exec":
            return self.code(getattr(arguments[0], "co_filename", "?"))
        if event == "compile":
            # NumPy parses headers of arrays with `ast.literal_eval`, to a tree that is not run; running is `exec`.
            return "" if arguments[1] == "<unknown>" else self.code(arguments[1])
        if event == "open":
            return self.opened(arguments[0], arguments[1], arguments[2])
        if event == "import":
            file = str(arguments[1] or "")
            return file if file.startswith(self.folder) else ""
        if event in RUNS or event in CHANGES or event.startswith(NETWORK) or event == "pickle.find_class":
            return repr(arguments)
        return ""

    def code(self, file: object) -> str:
        """Only the source of installed modules may run: a lazy import."""
        name = os.path.realpath(os.fsdecode(file)) if isinstance(file, str | bytes) else repr(file)
        frozen = isinstance(file, str) and file.startswith("<frozen ")
        return "" if frozen or name.startswith(LIBRARIES) else repr(file)

    def opened(self, path: object, mode: object, flags: object) -> str:
        if isinstance(path, int):
            return ""
        name = os.path.realpath(os.fsdecode(path))  # type: ignore[arg-type]
        writes = (isinstance(flags, int) and bool(flags & WRITES)) or (
            isinstance(mode, str) and bool(set(mode) & set("wax+"))
        )
        inside = name == self.now or name.startswith(f"{self.now}/") or name.startswith(LIBRARIES)
        return f"{name} for writing" if writes else "" if inside else name


def read(path: Path) -> str:
    """How reading a file ends: ``read``, or the start of the message."""
    try:
        if path.suffix == ".toml":
            (load_experiment if "settings" in path.name else load_signal_map)(path)
        elif path.suffix == ".npz":
            Snapshot.load(path)
        elif path.is_dir() and (path / "bundle.json").is_file():
            load_bundle(path)
        else:
            raw = FORMATS[format_for(path).name].read(path, SignalMap())
            for signal in raw.signals.values():
                signal.load()
                signal.time_s  # noqa: B018 - read for what reading does
    except EdpError as error:
        return f"{type(error).__name__}: {error}"[:300]
    return "read"


def main() -> None:
    folder = Path(sys.argv[1])
    trace, ends, events = Trace(folder), {}, {}
    files = sorted(folder.iterdir())
    for path in [file for file in files if file.name.startswith("honest")]:
        ends[path.name] = read(path)
    keep_temporary_files_in_memory()
    load_plugins()  # an unknown name looks for them, once a process
    for path in [file for file in files if not file.name.startswith(("honest", "other"))]:
        trace.seen, trace.now, trace.armed = [], os.path.realpath(path), True
        ends[path.name] = read(path)
        trace.armed = False
        events[path.name] = trace.seen
    print(json.dumps({"events": events, "ends": ends}))


if __name__ == "__main__":
    main()
