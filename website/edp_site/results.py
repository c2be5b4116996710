"""Pages of results: headlines, one page per benchmark, and the leaderboard, all made from benchmarks/results."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

MAX_HEADLINES, MAX_NOTE_WORDS = 20, 80
DIRECTIONS = ("lower", "higher")
SHOWN_UNITS = {"1": "", "ratio": "", "share": "", "mm/s recovered": "mm/s", "s of motion": "s"}
"""Units as they are shown, where they differ from those of the results."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a result file; ``benchmarks/verdicts.py`` writes it and describes its fields."""

    id: str
    title: str
    value: float | None
    reference: float | None
    reference_name: str
    unit: str
    direction: str
    target: float
    headline: bool
    docs: str

    @property
    def is_met(self) -> bool:
        """Whether the value, relative to a named reference, meets the target."""
        if self.value is None:
            return False
        compared = self.value / self.reference if self.reference else self.value
        return compared <= self.target if self.direction == "lower" else compared >= self.target

    @property
    def goal(self) -> str:
        """Target in words."""
        sign = "≤" if self.direction == "lower" else "≥"
        return f"{sign} {figure(self.target)} ×" if self.reference_name else f"{sign} {_value(self.target, self.unit)}"

    @property
    def outcome(self) -> str:
        """Outcome in words."""
        return "met" if self.is_met else "**missed**"


@dataclass(frozen=True)
class Result:
    """Result file of a benchmark: its name, what measured it, and its verdicts."""

    name: str
    command: str
    date: str
    seed: int
    verdicts: tuple[Verdict, ...]

    @property
    def script(self) -> str:
        """Name of the benchmark that wrote the file."""
        return self.command.split()[0].removesuffix(".py")

    @property
    def shown_command(self) -> str:
        """Command without folders of the machine that ran it."""
        words = [word if not word.startswith("/") else "DATA" for word in self.command.split()]
        return "python benchmarks/" + " ".join(words)


def read_result(path: Path) -> Result:
    """Read a result file.

    Raises:
        ValueError: the file or a verdict does not have the keys of the schema.
    """
    content: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    for key in ("command", "date", "seed", "verdicts"):
        if key not in content:
            raise ValueError(f"{path.name} has no '{key}'; run its benchmark again")
    names = {field.name for field in fields(Verdict)}
    for row in content["verdicts"]:
        if set(row) != names:
            raise ValueError(f"{path.name}: got a verdict with {sorted(row)}, expected {sorted(names)}")
    verdicts = tuple(Verdict(**row) for row in content["verdicts"])
    return Result(path.stem, content["command"], content["date"], content["seed"], verdicts)


def read_results(folder: Path) -> list[Result]:
    """Read all result files of a folder."""
    return [read_result(path) for path in sorted(folder.glob("*.json"))]


@dataclass(frozen=True)
class Goal:
    """Goal that was asked of EDP.

    Attributes:
        asked: the goal in words.
        result: name of the result file, or an empty text if none answers it.
        verdicts: titles of the verdicts that answer it.
        measured: why no verdict answers it.
        test: test that checks it.
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
        results: names of the result files of these options.
    """

    script: str
    reason: str
    place: str
    parts: str = ""
    results: tuple[str, ...] = ()

    def covers(self, result: Result) -> bool:
        """Return whether a result can only be measured again with the archived script."""
        return result.name in self.results or (not self.parts and result.script == self.script)


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


@dataclass(frozen=True)
class Page:
    """Texts of a benchmark page: script, title, question, page of docs/ on the subject, notes."""

    script: str
    title: str
    question: str
    docs: str
    notes: str


@dataclass(frozen=True)
class Headline:
    """Verdict on the first page.

    Attributes:
        result: name of the result file.
        title: title of the verdict.
        task: task in words.
        metric: metric in words.
        reference_title: another verdict of the result, whose reference is shown.
        published: published model of ``examples/real/leagues.toml``, which is shown as reference.
    """

    result: str
    title: str
    task: str
    metric: str
    reference_title: str = ""
    published: str = ""


@dataclass(frozen=True)
class Benchmarks:
    """Everything that the pages of results show.

    Attributes:
        results: result files by name.
        pages: texts of the benchmark pages, one per script.
        headlines: verdicts of the first page.
        goals: goals that were asked.
        archive: removed benchmarks.
        docs: folder of the hand-written pages; links to pages that it lacks are left out.
        published: errors of published models by name.
    """

    results: tuple[Result, ...]
    pages: tuple[Page, ...]
    headlines: tuple[Headline, ...]
    goals: tuple[Goal, ...]
    archive: tuple[Archived, ...]
    docs: Path
    published: Mapping[str, float]

    def find_by_script(self, script: str) -> list[Result]:
        """Return the result files of a script."""
        return [result for result in self.results if result.script == script]

    def verdict(self, headline: Headline, title: str = "") -> Verdict:
        """Return the verdict of a headline, or another one of its result by title."""
        result = next(one for one in self.results if one.name == headline.result)
        return next(one for one in result.verdicts if one.title == (title or headline.title))

    def reference(self, headline: Headline) -> str:
        """Return the best reference of a headline in words."""
        if headline.published:
            return f"{figure(self.published[headline.published])} ({headline.published})"
        return reference_text(self.verdict(headline, headline.reference_title))

    def outcomes(self, goal: Goal) -> list[bool]:
        """Return which verdicts of a goal are met."""
        found = [one.verdicts for one in self.results if one.name == goal.result]
        return [verdict.is_met for verdicts in found for verdict in verdicts if verdict.title in goal.verdicts]


def read_benchmarks(root: Path) -> Benchmarks:
    """Read results, catalogue, goals and archive of a repository."""
    folder = root / "benchmarks"
    catalogue = tomllib.loads((folder / "catalogue.toml").read_text(encoding="utf-8"))
    leagues = tomllib.loads((root / "examples" / "real" / "leagues.toml").read_text(encoding="utf-8"))
    return Benchmarks(
        tuple(read_results(folder / "results")),
        tuple(Page(**row) for row in catalogue["page"]),
        tuple(Headline(**row) for row in catalogue["headline"]),
        tuple(read_goals(folder / "goals.toml")),
        tuple(read_archive(folder / "archive.toml")),
        root / "docs",
        {name: value for league in leagues["leagues"] for name, value in league["published"].items()},
    )


def place_of(result: Result) -> str:
    """Return the page of a result file, from the folder of all pages, with its anchor."""
    return f"results/{result.script}.md#{result.name}"


def results_page(benchmarks: Benchmarks) -> str:
    """Return the first page of results: headline figures, then the benchmarks by topic."""
    shown = [benchmarks.verdict(headline) for headline in benchmarks.headlines]
    met = sum(verdict.is_met for verdict in shown)
    lines = [
        "---",
        "hide: [toc]",
        "---",
        "",
        "# Results",
        "",
        f"{len(shown)} headline figures, {met} targets met, {len(shown) - met} missed. Each task leads to its "
        "benchmark: command, notes and all figures. A reference was measured in the same run unless it was published. "
        "A target with × is a multiple of the reference. MAE: mean absolute error; RMSE: root mean square error.",
        "",
        "| Task | Metric | EDP | Best reference | Target | Outcome |",
        "|---|---|---:|---|---|---|",
    ]
    for headline, verdict in zip(benchmarks.headlines, shown, strict=True):
        place = place_of(next(one for one in benchmarks.results if one.name == headline.result))
        lines.append(
            f"| [{headline.task}]({place}) | {headline.metric} | {_value(verdict.value, verdict.unit)} "
            f"| {benchmarks.reference(headline)} | {verdict.goal} | {verdict.outcome} |"
        )
    lines += [
        "",
        "All verdicts are on the [leaderboard](leaderboard.md). Attempts, measurements without a benchmark and their "
        "conclusions are in the [journal](journal/index.md). [Limits](limits.md) state where not to use EDP.",
        "",
        "## Benchmarks",
        "",
        "| Benchmark | Question | Verdicts | Met | Last run |",
        "|---|---|---:|---:|---|",
    ]
    for page in benchmarks.pages:
        results = benchmarks.find_by_script(page.script)
        verdicts = [verdict for result in results for verdict in result.verdicts]
        lines.append(
            f"| [{page.title}](results/{page.script}.md) | {page.question} | {len(verdicts)} "
            f"| {sum(one.is_met for one in verdicts)} | {max((one.date for one in results), default='')} |"
        )
    return "\n".join(lines) + "\n"


def benchmark_page(benchmarks: Benchmarks, page: Page) -> str:
    """Return the page of a benchmark: question, notes, goals, and a table per result file."""
    lines = [f"# {page.title}", "", page.question, "", page.notes, ""]
    if (benchmarks.docs / page.docs).is_file():
        lines += [f"[Documentation](../{page.docs.replace('.ipynb', '.md')})", ""]
    results = benchmarks.find_by_script(page.script)
    names = {result.name for result in results}
    if goals := [goal for goal in benchmarks.goals if goal.result in names]:
        lines += ["| Goal that was asked | Outcome |", "|---|---|"]
        lines += [f"| {goal.asked} | {_outcome(benchmarks.outcomes(goal))} |" for goal in goals]
        lines.append("")
    for result in results:
        lines += [
            f"## {result.name}",
            "",
            "```sh",
            result.shown_command,
            "```",
            "",
            f"{result.date}, seed {result.seed}. All figures: `benchmarks/results/{result.name}.json`.",
            "",
        ]
        for one in benchmarks.archive:
            if one.covers(result):
                lines += [f"Archived: {one.reason}. Script: `git show {one.place}`.", ""]
        lines += _table(result.verdicts)
        lines.append("")
    return "\n".join(lines)


def leaderboard_page(benchmarks: Benchmarks) -> str:
    """Return the page of all verdicts: headlines first, then by benchmark; the goals that were asked come last."""
    verdicts = [verdict for result in benchmarks.results for verdict in result.verdicts]
    met = sum(verdict.is_met for verdict in verdicts)
    lines = [
        "# Leaderboard",
        "",
        f"{len(benchmarks.results)} result files, {len(verdicts)} verdicts, {met} targets met, {len(verdicts) - met} "
        "missed. Files of one benchmark with other arguments repeat verdicts, so the count is no score. A target with "
        "× is a multiple of the reference.",
        "",
        "## Headlines",
        "",
        *_table([benchmarks.verdict(headline) for headline in benchmarks.headlines]),
    ]
    for page in benchmarks.pages:
        lines += ["", f"## {page.title}"]
        for result in benchmarks.find_by_script(page.script):
            lines += ["", f"[{result.name}]({place_of(result)}), {result.date}", "", *_table(result.verdicts)]
    lines += ["", "## Goals that were asked", "", "| Goal | Outcome | Measured by |", "|---|---|---|"]
    for goal in benchmarks.goals:
        if goal.result:
            place = place_of(next(one for one in benchmarks.results if one.name == goal.result))
            outcome, source = _outcome(benchmarks.outcomes(goal)), f"[{goal.result}]({place})"
        else:
            outcome, source = (
                ("checked by a test", f"`{goal.test}`") if goal.test else ("no result file", goal.measured)
            )
        lines.append(f"| {goal.asked} | {outcome} | {source} |")
    return "\n".join(lines) + "\n"


def _outcome(outcomes: Sequence[bool]) -> str:
    text = "met" if all(outcomes) else "**missed**"
    return text + (f" ({sum(outcomes)} of {len(outcomes)})" if 0 < sum(outcomes) < len(outcomes) else "")


def _table(verdicts: Sequence[Verdict]) -> list[str]:
    if not verdicts:
        return ["No target was set; the file holds the figures."]
    rows = ["| Verdict | EDP | Reference | Target | Outcome |", "|---|---:|---|---|---|"]
    for one in verdicts:
        title = one.title.replace("|", "\\|")
        rows.append(f"| {title} | {_value(one.value, one.unit)} | {reference_text(one)} | {one.goal} | {one.outcome} |")
    return rows


def reference_text(verdict: Verdict) -> str:
    """Return the reference of a verdict with its name, or an empty text."""
    if not verdict.reference_name:
        return ""
    return f"{figure(verdict.reference)} ({verdict.reference_name})"


def _value(value: float | None, unit: str) -> str:
    return f"{figure(value)} {SHOWN_UNITS.get(unit, unit)}".rstrip()


def figure(value: float | None) -> str:
    """Return a number with four digits, large ones in groups of three."""
    if value is None:
        return ""
    if abs(value) >= 10_000:
        return f"{value:,.0f}"
    return f"{value:.4g}"
