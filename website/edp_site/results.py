"""The leaderboard: every verdict of benchmarks/results, as the benchmarks left it."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_FIELDS = ("name", "ours", "rival", "ratio", "goal", "met", "unit")


@dataclass(frozen=True)
class Goal:
    """Goal that was asked of EDP.

    Attributes:
        asked: the goal in words.
        result: name of the kept result, or an empty text if none answers it.
        verdicts: names of the verdicts that answer it.
        measured: why no kept verdict answers it.
        test: test that holds it.
    """

    asked: str
    result: str = ""
    verdicts: tuple[str, ...] = ()
    measured: str = ""
    test: str = ""


def read_goals(path: Path) -> list[Goal]:
    """Return the goals of ``benchmarks/goals.toml``."""
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["goal"]
    return [Goal(**row | {"verdicts": tuple(row.get("verdicts", ()))}) for row in rows]


@dataclass(frozen=True)
class Archived:
    """Benchmark, or part of one, that was removed because its question is answered.

    Attributes:
        script: name of the script.
        reason: why it is not measured again.
        place: argument of ``git show`` that prints the script.
        parts: removed options; an empty text if the whole script was removed.
        results: names of the kept results of these options.
    """

    script: str
    reason: str
    place: str
    parts: str = ""
    results: tuple[str, ...] = ()

    def covers(self, name: str, result: Mapping[str, Any]) -> bool:
        """Return whether a kept result can only be measured again with the archived script."""
        return name in self.results or (not self.parts and _script(result) == self.script)


def read_archive(path: Path) -> list[Archived]:
    """Return the rows of ``benchmarks/archive.toml``."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    return [
        Archived(
            **row
            | {"results": tuple(row.get("results", ())), "place": f"{table['commit']}:benchmarks/{row['script']}.py"}
        )
        for row in table["archived"]
    ]


def results_page(folder: Path, goals: Sequence[Goal], archive: Sequence[Archived] = ()) -> str:
    """Return a page with one table per benchmark, its command and its date; no figure is typed by hand.

    Args:
        folder: folder of the JSON files that benchmarks write.
        goals: goals that were asked; a table of them comes first.
        archive: removed benchmarks; their results name the commit that has the script.

    Raises:
        ValueError: a file lacks what every result has.
    """
    files = sorted(folder.glob("*.json"))
    results = [(path, _checked(path)) for path in files]
    verdicts = [verdict for _, result in results for verdict in result["verdicts"]]
    met = sum(verdict["met"] for verdict in verdicts)
    lines = [
        "# Leaderboard",
        "",
        "Made from the files that the benchmarks wrote (`benchmarks/results`). A row is one question: our figure, that "
        "of a rival measured in the same run, their ratio, and the goal that the ratio was to keep. Goals that were "
        "missed stay in the table. [Results](results.md) tell what was compared, on which data, and what it does not "
        "show.",
        "",
        f"{len(files)} files, {len(verdicts)} questions, {met} goals met, {len(verdicts) - met} missed. Files of one "
        "benchmark with other arguments repeat questions, so the count is no score.",
        "",
        *_goals(goals, {path.stem: result["verdicts"] for path, result in results}),
        "| Benchmark | Questions | Met | Date |",
        "|---|---:|---:|---|",
    ]
    for path, result in results:
        given = result["verdicts"]
        lines.append(
            f"| [{path.stem}](#{path.stem}) | {len(given)} | {sum(one['met'] for one in given)} | {result['date']} |"
        )
    for path, result in results:
        lines += [
            "",
            f"## {path.stem}",
            "",
            "```sh",
            _command(result),
            "```",
            "",
            f"{result['date']}, seed {result['seed']}.",
            "",
        ]
        for one in archive:
            if one.covers(path.stem, result):
                lines += [f"Archived: {one.reason}. Script: `git show {one.place}`.", ""]
        lines += _table(result["verdicts"])
    return "\n".join(lines) + "\n"


def _goals(goals: Sequence[Goal], kept: Mapping[str, list[Mapping[str, Any]]]) -> list[str]:
    rows = ["| Goal that was asked | Outcome | Measured by |", "|---|---|---|"]
    for goal in goals:
        outcomes = [one["met"] for one in kept.get(goal.result, []) if one["name"] in goal.verdicts]
        if goal.result:
            outcome = "met" if all(outcomes) else "**missed**"
            outcome += f" ({sum(outcomes)} of {len(outcomes)})" if 0 < sum(outcomes) < len(outcomes) else ""
            source = f"[{goal.result}](#{goal.result})"
        else:
            outcome, source = ("held by a test", f"`{goal.test}`") if goal.test else ("not kept", goal.measured)
        rows.append(f"| {goal.asked} | {outcome} | {source} |")
    return [*rows, ""]


def _checked(path: Path) -> Mapping[str, Any]:
    result = json.loads(path.read_text(encoding="utf-8"))
    for key in ("command", "date", "seed", "verdicts"):
        if key not in result:
            raise ValueError(f"{path.name} has no '{key}'; run its benchmark again")
    for verdict in result["verdicts"]:
        if missing := [key for key in _FIELDS if key not in verdict]:
            raise ValueError(f"{path.name}: a verdict has no {missing}; run its benchmark again")
    return result  # type: ignore[no-any-return]


def _script(result: Mapping[str, Any]) -> str:
    return str(result["command"]).split()[0].removesuffix(".py")


def _command(result: Mapping[str, Any]) -> str:
    """The command without folders of the machine that ran it."""
    words = [word if not word.startswith("/") else "DATA" for word in str(result["command"]).split()]
    return "python benchmarks/" + " ".join(words).replace("|", "\\|")


def _table(verdicts: list[Mapping[str, Any]]) -> list[str]:
    if not verdicts:
        return ["No goal was set; the file holds the figures."]
    rows = ["| Question | Ours | Rival | Unit | Ratio | Goal | Outcome |", "|---|---:|---:|---|---:|---|---|"]
    for one in verdicts:
        unit = "" if one["unit"] == "1" else one["unit"]
        name = str(one["name"]).replace("|", "\\|")
        rows.append(
            f"| {name} | {figure(one['ours'])} | {figure(one['rival'])} | {unit} "
            f"| {figure(one['ratio'])} | {one['goal']} | {'met' if one['met'] else '**missed**'} |"
        )
    return rows


def figure(value: float | None) -> str:
    """A number with four digits, large ones in groups of three."""
    if value is None:
        return ""
    if abs(value) >= 10_000:
        return f"{value:,.0f}"
    return f"{value:.4g}"
