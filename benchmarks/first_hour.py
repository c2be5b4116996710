"""A newcomer's first hour: from a folder of unknown logs to a report page, on every measured set that is at hand.

Only what a newcomer has is given: the folder, and then the commands that `edp init` prints, with ``--minutes`` on the
training. What each column is stands below, from the descriptions of the sets; a column that `edp init` leaves as a
number without a unit and says so ("unsure") is mapped right where its role is, since nothing in such a log tells more;
a kind that it names must be the true one. The sets are shared data that this repository does not hold.
"""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from common import finish, in_folder, kept, parser, table, verdict

MOST_COMMANDS = 5
WAYS_OUT = {"inspect": (0, 3), "evaluate": (0, 6)}
"""Exit codes that say something of the data or the model: 3, the logs have faults; 6, a baseline is better."""


@dataclass(frozen=True)
class Truth:
    """What a column is.

    Attributes:
        role: one of those of `edp init`.
        kind: of the quantity; empty where the set's description does not say it, or EDP has no such kind.
        unit: as `edp init` writes it; empty with the kind.
    """

    role: str
    kind: str = ""
    unit: str = ""


_BAR, _FLOW, _DEGREE = (
    Truth("measured", "pressure", "bar"),
    Truth("measured", "flow", "L/min"),
    Truth("measured", "temperature", "degC"),
)
SETS: dict[str, dict[str, Truth]] = {
    "cascaded_tanks": {
        "uEst": Truth("command", "voltage", "V"),
        "uVal": Truth("command", "voltage", "V"),
        # The level is given in volts of its sensor.
        "yEst": Truth("measured"),
        "yVal": Truth("measured"),
        "Ts": Truth("time"),
    },
    "emps": {
        "qg": Truth("reference", "position", "m"),
        "qm": Truth("measured", "position", "m"),
        "t": Truth("time"),
        "vir": Truth("command", "voltage", "V"),
    },
    "fatigue_rig_faster": {
        "t": Truth("time"),
        "r": Truth("reference"),
        "u": Truth("command", "voltage", "V"),
        "y": Truth("measured"),
        "d": Truth("measured", "position", "mm"),
    },
    "hydraulic_actuator_sjoberg": {"x": Truth("measured"), "u": Truth("command"), "p": Truth("measured")},
    "hydraulic_bench_mataveid": {
        "column_1": Truth("time"),
        "column_2": Truth("reference"),
        "column_3": Truth("measured"),
        "column_4": Truth("command"),
    },
    "hydraulic_condition_uci": {
        "cycle": Truth("counter"),
        "second": Truth("time"),
        **{f"PS{n}": _BAR for n in range(1, 7)},
        "EPS1": Truth("measured", "power", "W"),
        **{f"FS{n}": _FLOW for n in (1, 2)},
        **{f"TS{n}": _DEGREE for n in range(1, 5)},
        **{name: Truth("measured") for name in ("VS1", "SE", "CE", "CP")},
        "cooler_percent": Truth("label", "ratio", "%"),
        "valve_percent": Truth("label", "ratio", "%"),
        "pump_leak": Truth("label"),
        "accumulator_bar": Truth("label", "pressure", "bar"),
        "stable_flag": Truth("label"),
    },
}
"""Columns of the set's group of logs that `edp init` takes first, with what they are."""
_NO_QUANTITY = ("time", "counter")


def judged(guess: dict[str, Any], truth: Truth) -> str:
    """Right, said (the role is wrong or the kind is, but it was said to be unsure), or wrong."""
    if guess["role"] != truth.role:
        return "said" if guess["sure"] == "unsure" else "wrong"
    if truth.role in _NO_QUANTITY:
        return "right"
    if guess["kind"] == "generic":
        # Without a unit nothing is claimed; that must be said where there is one, but for labels, which are numbers.
        return "right" if guess["sure"] == "unsure" or not truth.kind else "wrong"
    same = (guess["kind"], guess["unit"]) == (truth.kind, truth.unit)
    return "right" if same else "said" if guess["sure"] == "unsure" else "wrong"


class Newcomer:
    """Types commands in an empty folder.

    Args:
        folder: that commands run in.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.steps = folder, []
        folder.mkdir(parents=True, exist_ok=True)

    steps: list[dict[str, Any]]

    def edp(self, *words: str) -> str:
        """Run a command; its standard output."""
        began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        variables = {**os.environ, "COLUMNS": "80", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        call = [sys.executable, "-m", "edp", *words]
        done = subprocess.run(call, cwd=self.folder, env=variables, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        self.steps.append(
            {
                "command": words[0],
                "exit_code": done.returncode,
                "wall_s": time.monotonic() - began,
                "processor_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
                "widest_line": max((len(line) for line in done.stdout.splitlines()), default=0),
                "last_words": (done.stdout + done.stderr).strip().splitlines()[-1:],
            }
        )
        return done.stdout

    @property
    def stuck(self) -> list[str]:
        """Commands that ended otherwise than they should."""
        return [
            step["command"]
            for step in self.steps
            if step["exit_code"] not in WAYS_OUT.get(step["command"], (0,))
        ]  # fmt: skip


def first_hour(logs: Path, columns: dict[str, Truth], folder: Path, minutes: float) -> dict[str, Any]:
    """The whole way on one set: what was mapped how, and each command's figures."""
    person = Newcomer(folder)
    facts = json.loads(person.edp("init", str(logs), "--yes", "--overwrite", "--json") or "{}")
    guesses = {guess["column"]: guess for guess in facts.get("columns", [])}
    fates = {name: judged(guesses[name], truth) if name in guesses else "wrong" for name, truth in columns.items()}
    unknown = sorted(set(guesses) - set(columns))
    for line in facts.get("next", []):
        words = shlex.split(line)[1:]
        if words[0] == "train":
            words += ["--minutes", f"{minutes:g}"]
        person.edp(*words)
        if person.stuck:
            break
    report = next(iter(folder.glob("runs/*/report.html")), None)
    return {
        "channels": len(columns),
        **{fate: sum(one == fate for one in fates.values()) for fate in ("right", "said", "wrong")},
        "unit_left_open": sum(guess["sure"] == "unsure" for guess in guesses.values()),
        "not_right": {name: fate for name, fate in fates.items() if fate != "right"} | dict.fromkeys(unknown, "extra"),
        "commands": len(person.steps),
        "stuck": person.stuck,
        "report_bytes": report.stat().st_size if report else 0,
        "wall_s": sum(step["wall_s"] for step in person.steps),
        "processor_s": sum(step["processor_s"] for step in person.steps),
        "steps": person.steps,
    }


def main() -> None:
    """See the module's text."""
    made = parser(__doc__ or "")
    made.add_argument("shared", type=Path, nargs="?", default=Path("../shared/data"), help="folder of the sets")
    made.add_argument("--minutes", type=float, default=0.3, help="of each training")
    made.add_argument("--set", action="append", dest="names", help="only this set; may be repeated; nothing is kept")
    arguments = made.parse_args()
    chosen = arguments.names or list(SETS)[: 1 if arguments.quick else None]
    there = [name for name in chosen if (arguments.shared / name).is_dir()]
    if not there:
        print(f"none of the sets is in {arguments.shared}; give the folder that holds them")
        return
    results: dict[str, Any] = {}

    def run(folder: Path) -> None:
        for name in there:
            logs = (arguments.shared / name).resolve()
            way = partial(first_hour, logs, SETS[name], folder / name, arguments.minutes)
            results[name] = kept(folder / f"{name}.json", way)
            facts = {key: value for key, value in results[name].items() if key != "steps"}
            print(f"{name}: {json.dumps(facts)}", flush=True)

    in_folder(arguments.data, run)
    shown = ("channels", "right", "said", "wrong", "unit_left_open", "commands", "report_bytes", "processor_s")
    table(["set", *shown], [[name, *(one[key] for key in shown)] for name, one in results.items()])
    quick = arguments.quick
    least = min(one["right"] / one["channels"] for one in results.values())
    silent = sum(one["wrong"] for one in results.values())
    most = max(one["commands"] for one in results.values())
    finished = sum(bool(one["report_bytes"]) and not one["stuck"] for one in results.values())
    verdicts = [
        verdict("channels mapped right, worst set (against 90 %)", least, 0.9, ">= 1", "share", quick),
        verdict("columns silently wrong and one (against one)", silent + 1, 1, "<= 1", "columns", quick),
        verdict("commands to the report, worst set (against 5)", most, MOST_COMMANDS, "<= 1", "commands", quick),
        verdict("sets with a report (against all)", finished, len(results), ">= 1", "sets", quick),
    ]
    finish("first_hour", verdicts, arguments.seed, results, keep=not arguments.names)


if __name__ == "__main__":
    main()
