"""Verdicts of benchmarks: the comparison in a run, the form in a result file, and the catalogue of names and pages."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from edp.storage import read_json, write_json

FOLDER = Path(__file__).parent
LOWER, HIGHER = "lower", "higher"
"""Which values are better."""


@dataclass(frozen=True)
class Verdict:
    """Comparison of a value with a reference of the same run, or with a fixed target.

    Attributes:
        title: what is compared.
        value: value of EDP.
        reference: value of the reference, or the fixed target.
        goal: bound of ``value / reference``, such as ``<= 0.6``.
        unit: unit of value and reference.
    """

    title: str
    value: float
    reference: float
    goal: str
    unit: str

    @property
    def bound(self) -> float:
        """Number of the goal."""
        return float(self.goal.split()[1])

    @property
    def ratio(self) -> float:
        """Value over reference."""
        return self.value / self.reference if self.reference else float("inf")

    @property
    def is_met(self) -> bool:
        """Whether the goal is met; without a reference the value itself is compared."""
        ratio = self.ratio if self.reference else self.value
        return ratio <= self.bound if self.goal.startswith("<=") else ratio >= self.bound


@dataclass(frozen=True)
class StoredVerdict:
    """Verdict as a result file holds it.

    Attributes:
        id: name of the verdict, unique in its file.
        title: what is compared.
        value: value of EDP.
        reference: value of the reference, None without one.
        reference_name: name of the reference, an empty text without one.
        unit: unit of value and reference; "1" for numbers.
        direction: which values are better, ``lower`` or ``higher``.
        target: bound of ``value / reference``, without a reference of the value.
        headline: whether the verdict is on the first page of results.
        docs: page of docs/ on the subject.
    """

    id: str
    title: str
    value: float
    reference: float | None
    reference_name: str
    unit: str
    direction: str
    target: float
    headline: bool
    docs: str


@dataclass(frozen=True)
class ReferenceRule:
    """Name of the reference of all verdicts whose result and title match regular expressions."""

    title: str
    name: str
    result: str = ""


@dataclass(frozen=True)
class Catalogue:
    """Names, headlines and pages of verdicts in ``benchmarks/catalogue.toml``; the site reads its texts.

    Attributes:
        references: rules for the names of references.
        headlines: result and title of the verdicts on the first page of results.
        pages: page of docs/ on the subject of each script.
    """

    references: tuple[ReferenceRule, ...]
    headlines: frozenset[tuple[str, str]]
    pages: Mapping[str, str]

    def reference_name(self, result: str, title: str) -> str:
        """Return the name of a verdict's reference, or an empty text if the verdict has a fixed target only."""
        for rule in self.references:
            if re.search(rule.title, title) and re.match(rule.result, result):
                return rule.name
        return ""


@cache
def read_catalogue(path: Path = FOLDER / "catalogue.toml") -> Catalogue:
    """Read the catalogue."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    return Catalogue(
        tuple(ReferenceRule(**row) for row in table["reference"]),
        frozenset((row["result"], row["title"]) for row in table["headline"]),
        {row["script"]: row["docs"] for row in table["page"]},
    )


def slug(title: str) -> str:
    """Return a title as an identifier of lower-case words."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def stored_verdicts(verdicts: Iterable[Verdict], result: str, script: str) -> list[StoredVerdict]:
    """Return verdicts as a result file holds them.

    Args:
        verdicts: of one run.
        result: name of the result file.
        script: name of the benchmark.
    """
    catalogue = read_catalogue()
    rows = []
    for one in verdicts:
        name = catalogue.reference_name(result, one.title) if one.reference else ""
        rows.append(
            StoredVerdict(
                id=slug(one.title),
                title=one.title,
                value=one.value,
                reference=one.reference if name else None,
                reference_name=name,
                unit=one.unit,
                direction=LOWER if one.goal.startswith("<=") else HIGHER,
                target=one.bound if name or not one.reference else one.bound * one.reference,
                headline=(result, one.title) in catalogue.headlines,
                docs=catalogue.pages.get(script, ""),
            )
        )
    return rows


def refresh(result: str, script: str, verdict: Mapping[str, object]) -> dict[str, object]:
    """Return a stored verdict with reference name, headline and page of the present catalogue.

    Raises:
        ValueError: the catalogue adds or removes a reference, which changes the meaning of the target.
    """
    catalogue, title = read_catalogue(), str(verdict["title"])
    name = catalogue.reference_name(result, title) if verdict["reference"] is not None else ""
    if bool(name) != bool(verdict["reference_name"]):
        raise ValueError(f"{result}: verdict {title!r} has another kind of target in the catalogue; run the benchmark")
    headline, docs = (result, title) in catalogue.headlines, catalogue.pages.get(script, "")
    return {**verdict, "reference_name": name, "headline": headline, "docs": docs}


def main() -> None:
    """Write the catalogue's names, headlines and pages into all result files."""
    for path in sorted((FOLDER / "results").glob("*.json")):
        result = read_json(path)
        script = str(result["command"]).split()[0].removesuffix(".py")
        rows = [refresh(path.stem, script, one) for one in result["verdicts"]]
        if rows != result["verdicts"]:
            write_json(path, {**result, "verdicts": rows})


if __name__ == "__main__":
    main()
