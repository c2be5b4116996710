"""What every benchmark shares: arguments, a table for people, results kept, and a last line of JSON."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edp.progress import SilentProgress
from edp.storage import make_folder, read_json, write_json
from edp.storage.provenance import command_line, environment

RESULTS = Path(__file__).parent / "results"
TIMES, COUNTS = (
    ("s", "ms", "us", "s of motion"),
    ("instructions", "cycles", "bytes", "MB", "alarms", "networks", "starts"),
)
COSTS = frozenset({*TIMES, *COUNTS, "mm", "mm/s", "m/s rms", "deg", "sigma", "V", "raw", "RMSE"})
"""Units of which less is better."""


@dataclass(frozen=True)
class Verdict:
    """One question answered: ours against a rival measured in the same run.

    Attributes:
        name: the question.
        ours: our figure.
        rival: the rival's figure.
        ratio: ours over rival.
        goal: the bound on the ratio, such as ``<= 0.6`` or ``>= 15``.
        met: whether the ratio keeps the bound.
        unit: unit of ours and rival.
        quick: whether this was the short form.
    """

    name: str
    ours: float
    rival: float
    ratio: float
    goal: str
    met: bool
    unit: str
    quick: bool


class PrintedProgress(SilentProgress):
    """Progress with a line per note and per step."""

    def note(self, sentence: str) -> None:
        """Print a note."""
        print(sentence, flush=True)

    def step(self, done: int, **values: float) -> None:
        """Print a step."""
        print(done, *(f"{name} {value:.4f}" for name, value in values.items()), flush=True)


def verdict(name: str, ours: float, rival: float, goal: str, unit: str, quick: bool) -> Verdict:
    """Compare ``ours / rival`` with `goal`, for example ``<= 0.6``.

    Raises:
        ValueError: the goal asks for more of a cost; then `ours` and `rival` are interchanged.
    """
    sign, bound = goal.split()
    if unit in COSTS and sign == ">=":
        raise ValueError(f"verdict {name!r}: got goal '{goal}', but less {unit} is better; interchange the figures")
    ratio = ours / rival if rival else float("inf")
    met = ratio <= float(bound) if sign == "<=" else ratio >= float(bound)
    return Verdict(name, ours, rival, ratio, goal, met, unit, quick)


class BenchmarkParser(argparse.ArgumentParser):
    """Parser of the arguments of a benchmark that runs programs of the system.

    Args:
        description: text of ``--help``.
        programs: names of the programs; without one of them the benchmark ends before it begins.
    """

    def __init__(self, description: str, programs: Sequence[str] = ()) -> None:
        super().__init__(description=description)
        self.programs = tuple(programs)

    def parse_args(self, *given: Any, **options: Any) -> Any:
        """Return the arguments, or end with exit code 0 and a message that names the missing programs."""
        arguments = super().parse_args(*given, **options)
        if missing := [program for program in self.programs if shutil.which(program) is None]:
            print(f"skipped: {', '.join(missing)} not found; `make system-packages` installs the programs")
            raise SystemExit(0)
        return arguments


def parser(description: str, programs: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return a parser with the arguments of every benchmark; see `BenchmarkParser`."""
    made = BenchmarkParser(description, programs)
    made.add_argument("--quick", action="store_true", help="under a minute; figures are only indicative")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--data", type=Path, default=None, help="folder for simulated data, kept between runs")
    return made


def table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print aligned columns; numbers with four digits."""
    text = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(row[i]) for row in [list(headings), *text]) for i in range(len(headings))]
    for row in [list(headings), *text]:
        print("  ".join(cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths))))


def kept(path: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What an earlier run left in this file, or what is found now."""
    if not path.exists():
        write_json(path, measure())
    found: dict[str, Any] = read_json(path)
    return found


def finish(script: str, verdicts: Sequence[Verdict], seed: int, details: object = None, keep: bool = True) -> None:
    """Print the verdicts, keep the results of the full form unless told otherwise, end with one line of JSON."""
    print()
    rows = [[v.name, v.ours, v.rival, v.ratio, v.goal, "met" if v.met else "NOT MET", v.unit] for v in verdicts]
    table(["question", "ours", "rival", "ratio", "goal", "verdict", "unit"], rows)
    # No measurement is no number: JSON has none for it.
    plain = [finite(asdict(v)) for v in verdicts]
    if keep and not any(v.quick for v in verdicts):
        kept = {
            "command": command_line(),
            "date": time.strftime("%Y-%m-%d"),
            "seed": seed,
            "commit": commit(),
            "environment": environment(0),
            "verdicts": plain,
            "details": details,
        }
        write_json(RESULTS / f"{script}.json", kept)
    print(json.dumps(plain if len(plain) != 1 else plain[0]), flush=True)


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
    """Plain values as JSON can keep them: what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def in_folder(folder: Path | None, run: Callable[[Path], None]) -> None:
    """Run in a folder that stays, or in one that is gone afterwards."""
    if folder is not None:
        run(make_folder(folder))
        return
    with tempfile.TemporaryDirectory() as temporary:
        run(Path(temporary))
