"""A newcomer's first hour: from a folder of unknown logs to a report page, on every measured set that is at hand.

Only what a newcomer has is given: the folder, and then the commands that `edp init` prints, with ``--minutes`` on the
training. What each column is stands below, from the descriptions of the sets; a column that `edp init` leaves as a
number without a unit and says so ("unsure") is mapped right where its role is, since nothing in such a log tells more;
a kind that it names must be the true one. The sets are shared data that this repository does not hold.

A person's time is a model, not a measurement, since no person was watched (`person_seconds`): keys, words and questions
are counted from what the commands really print, and priced with published rates of people. Two figures are given: for
what asks for decisions, and for a person who types every command and reads every printed word.
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
from itertools import pairwise
from pathlib import Path
from typing import Any

from common import DATA_AND_PARTS, Bench, Skipped, benchmark, option, table

MAX_COMMANDS = 5
WAYS_OUT = {"inspect": (0, 3), "evaluate": (0, 6)}
"""Exit codes that say something of the data or the model: 3, the logs have faults; 6, a baseline is better."""
MAX_PERSON_S = 180.0
DECIDING = ("init", "inspect")
"""Commands whose answers ask for decisions."""
KEY_S, PREPARED_S = 0.28, 1.35
"""A keystroke of an average typist who is no secretary, and the thought ahead of a command: the keystroke-level model
(Card, Moran and Newell 1980)."""
COPIED_S = 5.0
"""To mark, copy and paste a printed line: 4.6 s by the same model (hand to the mouse and back, two pointings, a button
down and up, five keys)."""
WORD_S = 60 / 238
"""Silent reading of English prose, mean of 190 studies (Brysbaert 2019)."""
QUESTION_S = 3.0
"""To answer a question that `edp init` puts behind a column, or to leave it open: an assumption, from no source."""


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
        """Run a command that the person types, see `run`."""
        step, printed = self.run(*words)
        self.steps.append(step)
        return printed

    def run(self, *words: str) -> tuple[dict[str, Any], str]:
        """Run a command; its figures, and its standard output."""
        began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        variables = {**os.environ, "COLUMNS": "80", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        call = [sys.executable, "-m", "edp", *words]
        done = subprocess.run(call, cwd=self.folder, env=variables, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        step = {
            "command": words[0],
            "keys": len(shlex.join(["edp", *words])) + 1,
            "words": len(done.stdout.split()),
            "exit_code": done.returncode,
            "wall_s": time.monotonic() - began,
            "processor_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            "widest_line": max((len(line) for line in done.stdout.splitlines()), default=0),
            "last_words": (done.stdout + done.stderr).strip().splitlines()[-1:],
        }
        return step, done.stdout

    @property
    def stuck(self) -> list[str]:
        """Commands that ended otherwise than they should."""
        return [
            step["command"]
            for step in self.steps
            if step["exit_code"] not in WAYS_OUT.get(step["command"], (0,))
        ]  # fmt: skip


def person_seconds(result: dict[str, Any]) -> dict[str, float]:
    """Estimate a person's time in seconds, without waiting for the computer.

    Returns:
        ``deciding``: the first command is typed and the printed ones are copied; all that `edp init` and `edp data
        check` print is read, since it asks for decisions, and of the others the last line. ``reading_all``: every
        command is typed and every printed word is read, progress apart, which is rewritten in place.
    """
    steps = result["steps"]
    fixed = PREPARED_S * len(steps) + QUESTION_S * result["questions"]
    keys = [KEY_S * step["keys"] for step in steps]
    last = [sum(len(line.split()) for line in step["last_words"]) for step in steps]
    words = [step["words"] if step["command"] in DECIDING else some for step, some in zip(steps, last)]
    return {
        "deciding": fixed + sum(keys[:1]) + COPIED_S * len(keys[1:]) + WORD_S * sum(words),
        "reading_all": fixed + sum(keys) + WORD_S * result["words"],
    }


def first_hour(logs: Path, columns: dict[str, Truth], folder: Path, minutes: float) -> dict[str, Any]:
    """Run the complete workflow on one data set and return the signal mapping and the figures of each command."""
    person = Newcomer(folder)
    person.edp("init", str(logs), "--yes")
    # Once more for this script: a person reads the text.
    facts = json.loads(person.run("init", str(logs), "--yes", "--overwrite", "--json")[1] or "{}")
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
    asked = [(one["sure"], one["role"], one["unit"], one["check"]) for one in guesses.values() if one["check"]]
    # Columns side by side of which the same is likely are one question; each of which it is unsure is one.
    questions = sum(one[0] == "unsure" or one != before for before, one in pairwise([None, *asked]) if one[0] != "sure")
    return {
        "channels": len(columns),
        **{fate: sum(one == fate for one in fates.values()) for fate in ("right", "said", "wrong")},
        "unit_left_open": sum(guess["sure"] == "unsure" for guess in guesses.values()),
        "not_right": {name: fate for name, fate in fates.items() if fate != "right"} | dict.fromkeys(unknown, "extra"),
        "commands": len(person.steps),
        "keys": sum(step["keys"] for step in person.steps),
        "words": sum(step["words"] for step in person.steps),
        "questions": questions,
        "stuck": person.stuck,
        "report_bytes": report.stat().st_size if report else 0,
        "wall_s": sum(step["wall_s"] for step in person.steps),
        "processor_s": sum(step["processor_s"] for step in person.steps),
        "steps": person.steps,
    }


def shown_of(result: dict[str, Any]) -> dict[str, Any]:
    """Return the stored figures of a data set, without last lines of commands, which name local folders."""
    facts = {key: value for key, value in result.items() if key != "steps"}
    return facts | {"person_model_s": person_seconds(result)}


@benchmark(
    DATA_AND_PARTS,
    option("sets", type=Path, nargs="?", default=Path("../shared/data"), help="folder of the sets"),
    option("--minutes", type=float, default=0.3, help="of each training"),
    option("--set", action="append", dest="names", help="only this set; may be repeated; nothing is kept"),
)
def main(bench: Bench) -> object:
    chosen = bench.options.names or list(SETS)[: 1 if bench.quick else None]
    there = [name for name in chosen if (bench.options.sets / name).is_dir()]
    if not there:
        raise Skipped(f"none of the sets is in {bench.options.sets}; give the folder that holds them")
    results: dict[str, Any] = {}
    for name in there:
        logs = (bench.options.sets / name).resolve()
        results[name] = bench.part(
            name, partial(first_hour, logs, SETS[name], bench.folder / name, bench.options.minutes)
        )
        print(f"{name}: {json.dumps(shown_of(results[name]))}", flush=True)
    shown = ("channels", "right", "said", "wrong", "unit_left_open", "commands", "report_bytes", "processor_s")
    rows = [[name, *(one[key] for key in shown), *person_seconds(one).values()] for name, one in results.items()]
    table(["set", *shown, "deciding_s", "reading_all_s"], rows)
    print("deciding_s, reading_all_s: a person's time by a model of keys, words and questions, not measured on persons")
    least = min(one["right"] / one["channels"] for one in results.values())
    silent = sum(one["wrong"] for one in results.values())
    most = max(one["commands"] for one in results.values())
    longest = max(person_seconds(one)["deciding"] for one in results.values())
    finished = sum(bool(one["report_bytes"]) and not one["stuck"] for one in results.values())
    bench.check("correctly mapped channels, worst set", least, 0.9, ">= 1", "share")
    bench.check("silently wrong columns, plus one", silent + 1, 1, "<= 1", "columns")
    bench.check("commands until the report, worst set", most, MAX_COMMANDS, "<= 1", "commands")
    bench.check("estimated user time, worst set", longest, MAX_PERSON_S, "<= 1", "s")
    bench.check("sets with a report", finished, len(results), ">= 1", "sets")
    bench.keep = not bench.options.names
    return {name: shown_of(one) for name, one in results.items()}


if __name__ == "__main__":
    main()
