"""What was compiled is kept between runs, by content: `.pytest_cache/compiled`, which `make clean` removes.

A whole call is known by its arguments and every file that it may read. One that is new is divided: each C file is known
by its preprocessed text, so that the runtime, which every exported folder has, is compiled once for each set of flags.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

COMPILERS = frozenset({"cc", "gcc", "clang", "arm-none-eabi-gcc", "x86_64-w64-mingw32-gcc"})
ZIG = ("-m", "ziglang", "cc")
LINKED = ("-l", "-L", "-Wl,", "-shared", "-static", "-rdynamic", "-nostartfiles")
"""Beginnings of arguments of the linker, of which compilers complain where they do not link."""
BESIDE = (
    *("-M", "-E", "-S", "-x", "-flto", "-fprofile", "-ftest-coverage", "--coverage", "-save-temps", "-fsyntax-only"),
    "@",
)
"""Beginnings of arguments that read or write more than a source and its object."""
READ = (".c", ".h", ".inc", ".def")
"""Endings of files that a compiler may read beside those that it is given."""
DAYS = 14
"""After which what no test asked for is removed."""
SOURCES = Path(__file__).parents[2] / "src" / "edp" / "sim"


def warm_numba(cache: Path) -> None:
    """Let one process compile the simulator, unless one did for these sources.

    Side by side, each worker of the tests would compile its own variant.
    """
    if (cache / _state()).exists():
        return
    program = "from edp.sim import Scenario, simulate; simulate(Scenario(duration_s=0.5))"
    subprocess.run([sys.executable, "-c", program], check=True)
    cache.mkdir(parents=True, exist_ok=True)
    (cache / _state()).touch()


def _state() -> str:
    """Of the simulator's sources and of numba's cache (`edp.storage.machine_code`)."""
    digest = hashlib.sha256(sys.version.encode())
    for path in sorted(SOURCES.rglob("*.py")):
        digest.update(f"{path}\0".encode() + path.read_bytes())
    below = os.environ.get("NUMBA_CACHE_DIR") or f"{os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'}/edp"
    folders = [folder for folder in Path(below).glob("sim-*") if next(folder.rglob("*.nbi"), None)]
    digest.update(" ".join(sorted(folder.name for folder in folders)).encode())
    return f"simulator-{digest.hexdigest()[:32]}"


@dataclass(frozen=True)
class Call:
    """Of a compiler.

    Attributes:
        key: digest of the compiler, its arguments, and all files that it may read.
        outputs: files that it writes.
    """

    key: str
    outputs: tuple[Path, ...]


_plain = subprocess.run
_fresh: list[bool] = []


def install(cache: Path) -> None:
    """Let `subprocess.run` take programs that were compiled before from `cache`; for this process."""
    limit = time.time() - 86_400 * DAYS
    for entry in cache.glob("*.made"):
        with contextlib.suppress(OSError):  # a worker beside this one removes it, too
            if entry.stat().st_mtime < limit:
                shutil.rmtree(entry)

    def run(command: Any, *args: Any, **options: Any) -> Any:
        call = None if args or _fresh else call_of(command, options)
        if call is None:
            return _plain(command, *args, **options)
        entry = cache / f"{call.key}.made"
        if entry.is_dir():
            for output in call.outputs:
                shutil.copy(entry / output.name, output)
            with contextlib.suppress(OSError):
                os.utime(entry)
            silence: Any = "" if options.get("text") or options.get("encoding") else b""
            return subprocess.CompletedProcess(command, 0, silence, silence)
        done = _unit_by_unit(command, call, cache, options) or _plain(command, **options)
        # What is said (warnings) is kept by not keeping the program.
        if done.returncode == 0 and not done.stdout and not done.stderr and all(map(Path.is_file, call.outputs)):
            _keep(entry, call.outputs)
        return done

    subprocess.run = run  # type: ignore[assignment]


@contextlib.contextmanager
def fresh() -> Iterator[None]:
    """Everything is compiled anew, for tests of the compilers' own output."""
    _fresh.append(True)
    try:
        yield
    finally:
        _fresh.pop()


def call_of(command: Any, options: dict[str, Any]) -> Call | None:
    """A call of a compiler that writes files and says nothing; None for any other program."""
    if not isinstance(command, list | tuple) or not options.get("capture_output") or options.get("input"):
        return None
    words = [str(word) for word in command]
    zig = tuple(words[1:4]) == ZIG
    # `edp verify` calls a compiler by its whole path.
    if not zig and Path(words[0]).name not in COMPILERS:
        return None
    program = shutil.which(words[0])
    folder = Path(options.get("cwd") or Path.cwd())
    rest = words[4:] if zig else words[1:]
    outputs = _outputs(rest, folder)
    if program is None or not outputs:
        return None
    digest = hashlib.sha256()
    for text in (*_identity(program, zig), *(_word(word, folder, outputs) for word in rest)):
        digest.update(f"{text}\0".encode())
    for path in _inputs([word for word in rest if folder / word not in outputs], folder):
        digest.update(f"{path.name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return Call(digest.hexdigest()[:40], outputs)


def _unit_by_unit(command: Any, call: Call, cache: Path, options: dict[str, Any]) -> Any:
    """What the call returns, with each C file compiled on its own or taken from the cache.

    None where it cannot be divided, fails or says something: the caller then runs it as it is.
    """
    words = [str(word) for word in command]
    folder = Path(options.get("cwd") or Path.cwd())
    sources = [word for word in words if word.endswith(".c") and (folder / word).is_file()]
    if tuple(words[1:4]) == ZIG or not sources or any(word.startswith(BESIDE) for word in words[1:]):
        return None
    quiet = {**options, "capture_output": True}
    with tempfile.TemporaryDirectory(dir=cache.parent if cache.parent.is_dir() else None) as scratch:
        objects = {word: Path(scratch) / f"{number}.o" for number, word in enumerate(sources)}
        flags = _flags_of_units(words, sources)
        if not all(_unit([words[0], *flags], word, objects[word], cache, quiet) for word in sources):
            return None
        if "-c" in words:
            for target, word in zip(call.outputs, sources, strict=True):
                shutil.copy(objects[word], target)
            return subprocess.CompletedProcess(command, 0, *(("",) * 2 if options.get("text") else (b"",) * 2))
        done = _plain([str(objects.get(word, word)) for word in words], **quiet)
    return None if done.returncode or done.stdout or done.stderr else done


def _flags_of_units(words: Sequence[str], sources: Sequence[str]) -> list[str]:
    """Arguments that decide what an object is, with those of the preprocessor."""
    dropped = {*sources, "-c"}
    pairs = itertools.pairwise(words)
    return [
        word
        for before, word in pairs
        if word not in dropped
        and not {word, before} & {"-o", "-T"}
        and not word.startswith(LINKED)
        and not word.endswith((".o", ".a", ".so"))
    ]


def _unit(start: Sequence[str], source: str, target: Path, cache: Path, options: dict[str, Any]) -> bool:
    """Compile a C file into `target`, or take it from the cache; false where the compiler fails or says something."""
    text = _plain([*start, "-E", "-P", source], **{**options, "text": False, "encoding": None})
    program = shutil.which(start[0])
    if text.returncode or text.stderr or program is None:
        return False
    # What the preprocessor was told is in its text.
    told = [
        word
        for before, word in itertools.pairwise(start)
        if before not in ("-I", "-D", "-isystem") and not word.startswith(("-I", "-D", "-isystem"))
    ]
    digest = hashlib.sha256()
    for part in (*_identity(program, zig=False), *told, "unit"):
        digest.update(f"{part}\0".encode())
    digest.update(text.stdout)
    entry = cache / f"{digest.hexdigest()[:40]}.made"
    if not entry.is_dir():
        done = _plain([*start, "-c", source, "-o", str(target)], **options)
        if done.returncode or done.stdout or done.stderr:
            return False
        named = target.with_name("unit.o")
        shutil.copy(target, named)
        _keep(entry, (named,))
    shutil.copy(entry / "unit.o", target)
    with contextlib.suppress(OSError):
        os.utime(entry)
    return True


def _identity(program: str, zig: bool) -> tuple[str, ...]:
    """A compiler that is replaced has another size or time."""
    status = os.stat(os.path.realpath(program))
    if zig:
        from importlib.metadata import version

        return ("ziglang", version("ziglang"))
    return (program, str(status.st_size), str(status.st_mtime_ns))


def _outputs(words: Sequence[str], folder: Path) -> tuple[Path, ...]:
    if "-o" in words:
        target = folder / words[words.index("-o") + 1]
        return () if target.is_dir() else (target,)
    if "-c" in words:
        return tuple(folder / f"{Path(word).stem}.o" for word in words if word.endswith(".c"))
    return ()


def _word(word: str, folder: Path, outputs: Sequence[Path]) -> str:
    """An argument without the place of temporary folders."""
    path = folder / word
    if path in outputs or path.exists():
        return path.name
    return word.replace(str(folder), ".")


def _inputs(words: Sequence[str], folder: Path) -> list[Path]:
    """Files that are given, and sources in the folders of these, of the call and of ``-I``."""
    given = [path for word in words if (path := folder / word).is_file()]
    folders = {path.parent for path in given}
    named = [*words, *(word[2:] for word in words if word.startswith("-I"))]
    folders |= {path for word in named if word and (path := folder / word).is_dir()} | {folder}
    beside = {path for place in folders for ending in READ for path in place.glob(f"*{ending}")}
    return sorted({*given, *beside}, key=lambda path: (path.name, str(path.relative_to(path.parents[1]))))


def _keep(entry: Path, outputs: Sequence[Path]) -> None:
    """Whole or not at all: workers keep the same program at the same time."""
    part = entry.with_suffix(f".{os.getpid()}")
    part.mkdir(parents=True, exist_ok=True)
    for output in outputs:
        shutil.copy(output, part / output.name)
    try:
        part.rename(entry)
    except OSError:
        shutil.rmtree(part, ignore_errors=True)
