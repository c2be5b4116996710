"""Journal: one file per finding in docs/journal, and the page that lists them with a filter by tag."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from edp_site import markdown

MAX_WORDS = 80
TAGS = (
    "accuracy",
    "adaptation",
    "automatic choice",
    "compression",
    "control",
    "data quality",
    "export",
    "fleet",
    "grey box",
    "identification",
    "logs",
    "monitor",
    "networks",
    "not adopted",
    "public data",
    "screening",
    "search",
    "simulator",
    "speed",
    "statistics",
    "thesis",
    "training",
    "transfer",
    "twin",
)
_FIELDS = ("Question", "Setup", "Result", "Conclusion", "Command", "Date", "Tags")
_SYMBOLS = """\
`k` is the prediction horizon in samples of 10 ms. M22 and C14 are the simulated excavators of 22 t and 14 t.
Errors are mean absolute errors of cylinder velocities on held-out recordings, if nothing else is stated. Lists such as
"8/5/4" are boom, arm and bucket. A processor second is a second of computing time of one core."""


@dataclass(frozen=True)
class Finding:
    """One entry of the journal.

    Attributes:
        name: file name in docs/journal.
        title: result in one sentence.
        question: what was asked.
        setup: data, models and settings.
        result: measured figures.
        conclusion: decision or consequence.
        command: command that repeats the measurement, or why there is none.
        date: date of the entry, with the commit that added it.
        tags: topics, each one of `TAGS`.
    """

    name: str
    title: str
    question: str
    setup: str
    result: str
    conclusion: str
    command: str
    date: str
    tags: tuple[str, ...]

    @property
    def words(self) -> int:
        """Number of words of question, setup, result and conclusion."""
        return len(" ".join((self.question, self.setup, self.result, self.conclusion)).split())


def read_finding(path: Path) -> Finding:
    """Read an entry of the journal.

    Raises:
        ValueError: the entry does not have the form that CONTRIBUTING.md states ("Add a finding").
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [re.fullmatch(r"- (\w+): (.+)", line) for line in lines[2:]]
    fields = [row[1] for row in rows if row]
    if not lines[0].startswith("# ") or lines[1] or fields != list(_FIELDS) or None in rows:
        raise ValueError(f"{path.name}: got fields {fields}, expected a title and the lines {list(_FIELDS)}")
    question, setup, result, conclusion, command, date, tags = (row[2] for row in rows if row)
    names = tuple(tags.split(", "))
    if unknown := sorted(set(names) - set(TAGS)):
        raise ValueError(f"{path.name}: got tags {unknown}, expected some of {list(TAGS)}")
    return Finding(path.name, lines[0][2:], question, setup, result, conclusion, command, date, names)


def read_journal(folder: Path) -> list[Finding]:
    """Read all entries of a folder, ordered by number."""
    return [read_finding(path) for path in sorted(folder.glob("[0-9]*.md"))]


def journal_page(findings: Sequence[Finding]) -> str:
    """Return the page that lists all findings, newest first; scripts of the site filter its rows by tag."""
    lines = [
        "---",
        "hide: [toc]",
        "---",
        "",
        "# Journal",
        "",
        f"{len(findings)} findings: what was tried, what came out, what followed from it. Failed attempts are included "
        "(tag `not adopted`). Each title leads to question, setup, figures and command.",
        "",
        *_SYMBOLS.splitlines(),
        "",
        "| Finding | Conclusion | Tags | Date |",
        "|---|---|---|---|",
    ]
    for one in reversed(findings):
        title, conclusion = (text.replace("|", "\\|") for text in (one.title, one.conclusion))
        lines.append(f"| [{title}]({one.name}) | {conclusion} | {', '.join(one.tags)} | <time>{one.date[:10]}</time> |")
    return "\n".join(lines) + "\n"


def decisions_page(folder: Path) -> str:
    """Return the table of decisions with status and date."""
    lines = [
        "# Decisions",
        "",
        "Decisions on the design of EDP: the reason, the decision and its consequences. A replaced decision names its "
        "successor.",
        "",
        "| No. | Decision | Status | Date |",
        "|---|---|---|---|",
    ]
    for path in sorted(folder.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.sub(r"^\d+[.:]?\s*", "", markdown.headings(text)[0].text)
        state = re.search(
            r"^Status: (accepted|replaced by \[decision \d+\]\([^)]+\))\. Date: (\S+)\.$", text, re.MULTILINE
        )
        if state is None:
            raise ValueError(f"{path.name}: got no status line, expected 'Status: accepted. Date: 2026-01-31.'")
        lines.append(f"| {path.name[:4]} | [{title}]({path.name}) | {state[1]} | <time>{state[2]}</time> |")
    return "\n".join(lines) + "\n"
