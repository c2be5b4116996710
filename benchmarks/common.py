"""What every benchmark shares: arguments, a working folder, a table for people, kept results, a last line of JSON.

A benchmark is a function under `benchmark`, which is called with a `Bench`::

    @benchmark(WORK, option("--updates", type=int, default=400, help="of a training"), programs=("gcc",))
    def main(bench: Bench) -> object:
        found = measure(bench.folder, 10 if bench.quick else bench.options.updates)
        bench.check("error against the reference", found["error"], found["reference"], "<= 0.9", "mm/s")
        return found

The text of ``--help`` is that of the module. What the function returns is kept as ``details`` of the result.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edp.progress import SilentProgress
from edp.storage import make_folder, read_json, write_json
from edp.storage.provenance import command_line, environment
from verdicts import Verdict, stored_verdicts

ROOT = Path(__file__).resolve().parents[1]
RESULTS, EXAMPLES = ROOT / "benchmarks" / "results", ROOT / "examples" / "real"
VARIABLE = "EDP_SHARED_DATA"
TIMES, COUNTS = (
    ("s", "ms", "us", "s of motion"),
    ("instructions", "cycles", "bytes", "MB", "alarms", "networks", "starts"),
)
COSTS = frozenset({*TIMES, *COUNTS, "mm", "mm/s", "m/s rms", "deg", "sigma", "V", "raw", "RMSE"})
"""Units of which less is better."""


class Skipped(Exception):
    """Raised where a benchmark cannot run here; its text says what is missing."""


class PrintedProgress(SilentProgress):
    """Progress with a line per note and per step."""

    def note(self, sentence: str) -> None:
        """Print a note."""
        print(sentence, flush=True)

    def step(self, done: int, **values: float) -> None:
        """Print a step."""
        print(done, *(f"{name} {value:.4f}" for name, value in values.items()), flush=True)


def verdict(title: str, value: float, reference: float, goal: str, unit: str) -> Verdict:
    """Compare ``value / reference`` with `goal`, for example ``<= 0.6``.

    Raises:
        ValueError: the goal asks for more of a cost; then `value` and `reference` are interchanged.
    """
    if unit in COSTS and goal.startswith(">="):
        raise ValueError(f"verdict {title!r}: got goal '{goal}', but less {unit} is better; interchange the figures")
    return Verdict(title, value, reference, goal, unit)


@dataclass(frozen=True)
class Option:
    """Argument of a benchmark: its flags, and the keywords of ``argparse``."""

    flags: tuple[str, ...]
    keywords: Mapping[str, Any]


def option(*flags: str, **keywords: Any) -> Option:
    """Return an argument of a benchmark, written as for ``argparse``."""
    return Option(flags, keywords)


WORK = option("--work", type=Path, help="folder that keeps data and finished parts between runs")
DATA = option("--data", type=Path, help="folder for simulated data, kept between runs")
DATA_AND_PARTS = option("--data", dest="work", type=Path, help="folder that keeps data and finished parts between runs")
PLACE = option("--data", dest="place", type=Path, help="folder in which the temporary folder lies")
SHARED = option("--shared", type=Path, help=f"folder of the recordings (else ${VARIABLE})")


@dataclass
class Bench:
    """One call of a benchmark.

    Attributes:
        name: of the result, which is that of the script unless the benchmark changes it.
        options: arguments of the command line.
        folder: folder of ``--work``, or a temporary one.
        verdicts: answered questions.
        keep: whether the full form keeps its result among those of the repository.
    """

    name: str
    options: argparse.Namespace
    folder: Path
    verdicts: list[Verdict] = field(default_factory=list)
    keep: bool = True

    @property
    def quick(self) -> bool:
        """Whether the short form was asked for."""
        return bool(self.options.quick)

    @property
    def seed(self) -> int:
        """First seed."""
        return int(self.options.seed)

    @property
    def data(self) -> Path:
        """Folder of ``--data``, or one in the working folder."""
        return getattr(self.options, "data", None) or self.folder / "data"

    def check(self, title: str, value: float, reference: float, goal: str, unit: str) -> Verdict:
        """Add a verdict; see `verdict`. ``benchmarks/catalogue.toml`` names its reference."""
        self.verdicts.append(verdict(title, value, reference, goal, unit))
        return self.verdicts[-1]

    def part(self, name: str, measure: Callable[[], Any]) -> Any:
        """Return what an earlier run left of this part in the working folder, or what is measured now."""
        return kept(self.folder / f"{name}.json", measure)

    def finish(self, details: object = None) -> None:
        """Print the verdicts, keep the result, and print one line of JSON; the next result begins empty."""
        print()
        rows = [
            [v.title, v.value, v.reference, v.ratio, v.goal, "met" if v.is_met else "NOT MET", v.unit]
            for v in self.verdicts
        ]
        table(["verdict", "EDP", "reference", "ratio", "goal", "outcome", "unit"], rows)
        script = command_line().split()[0].removesuffix(".py")
        plain = [finite(asdict(v)) for v in stored_verdicts(self.verdicts, self.name, script)]
        if self.options.out or (self.keep and not self.quick):
            result = {
                "command": command_line(),
                "date": time.strftime("%Y-%m-%d"),
                "seed": self.seed,
                "commit": commit(),
                "environment": environment(0),
                "verdicts": plain,
                "details": finite(details),
            }
            write_json(make_folder(self.options.out or RESULTS) / f"{self.name}.json", result)
        self.verdicts.clear()
        print(json.dumps(plain if len(plain) != 1 else plain[0]), flush=True)


def benchmark(
    *options: Option, programs: Sequence[str] = ()
) -> Callable[[Callable[[Bench], object]], Callable[[Sequence[str] | None], None]]:
    """Make a command line of a function that measures.

    Args:
        options: arguments beside ``--quick``, ``--seed`` and ``--out``.
        programs: programs of the system; without one of them the benchmark ends before it begins.
    """

    def decorate(measure: Callable[[Bench], object]) -> Callable[[Sequence[str] | None], None]:
        @functools.wraps(measure)
        def main(arguments: Sequence[str] | None = None) -> None:
            given = _parse(measure.__globals__["__doc__"], options, arguments)
            try:
                if missing := [program for program in programs if shutil.which(program) is None]:
                    raise Skipped(f"{', '.join(missing)} not found; `make system-packages` installs the programs")
                if hasattr(given, "shared"):
                    given.shared = shared_folder(given.shared)
                with tempfile.TemporaryDirectory(dir=getattr(given, "place", None)) as temporary:
                    folder = make_folder(getattr(given, "work", None) or Path(temporary))
                    bench = Bench(Path(measure.__code__.co_filename).stem, given, folder)
                    details = measure(bench)
                    if details is not None or bench.verdicts:
                        bench.finish(details)
            except Skipped as missing_here:
                print(f"skipped: {missing_here}")
                print(json.dumps({"skipped": True, "why": str(missing_here)}))

        return main

    return decorate


def _parse(text: str, options: Sequence[Option], arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute; figures are only indicative")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder of the result, also of the short form")
    for one in options:
        parser.add_argument(*one.flags, **one.keywords)
    return parser.parse_args(arguments)


def shared_folder(given: Path | None) -> Path:
    """Return the folder of the real recordings, and make it known to data-set files.

    Raises:
        Skipped: the folder does not exist.
    """
    shared = given or Path(os.environ.get(VARIABLE) or ROOT.parent / "shared" / "data")
    if not shared.is_dir():
        raise Skipped(f"there is no folder of real recordings '{shared}'; give --shared or set {VARIABLE}")
    os.environ[VARIABLE] = str(shared.resolve())
    return shared


def table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print aligned columns; numbers with four digits."""
    text = [[f"{value:.4g}" if isinstance(value, float) else str(value) for value in row] for row in rows]
    widths = [max(len(row[i]) for row in [list(headings), *text]) for i in range(len(headings))]
    for row in [list(headings), *text]:
        print("  ".join(cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths))))


def kept(path: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the stored result of an earlier run, or measure and store it."""
    if not path.exists():
        write_json(path, finite(measure()))
    found: dict[str, Any] = read_json(path)
    return found


def commit() -> str:
    """Return the commit of the sources, with ``+`` if files differ from it, or an empty text outside a checkout."""
    try:
        given = {"cwd": RESULTS, "check": True, "capture_output": True, "text": True}
        name = subprocess.run(["git", "rev-parse", "HEAD"], **given).stdout.strip()
        changed = subprocess.run(["git", "status", "--porcelain", "--", "..", "../../src"], **given).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""
    return name + ("+" if changed else "")


def finite(value: Any) -> Any:
    """Plain values as JSON can keep them: what is not finite becomes None, numbers of NumPy those of Python."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
