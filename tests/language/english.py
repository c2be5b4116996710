"""Check of the language: constructions in docstrings and pages that readers do not understand at first reading.

``make english`` runs the check. It is a smoke detector: the goal is the reading test (``make reading-test``).
`allowed.toml` holds the present number of findings by file. A file may have fewer findings, never more.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
ALLOWED = Path(__file__).with_name("allowed.toml")
CODE = ("src/edp", "benchmarks", "website", "tests/language")
MAX_HITS_PER_1000_WORDS = 5.0
CONSTRUCTIONS = {
    "relative clause as a noun": (
        r"^(?:What|Where|Whose|Which|When|Of|By|As|That)\b|\bwhat (?:is|are|was|were|has|have|it|they|each)\b"
    ),
    "ellipsis": (
        r"\b(?:those|the ones?) (?:of|by|from|in|on|with|without|for)\b|: of (?:the|its|a|an|this|it|them|all|each)\b"
    ),
    "rate with an article": (
        r"\b(?:[Oo]ne|[Aa]n?|[Tt]wo|[0-9]+) [a-z]+ an? (?!few|little|lot|while|bit|time)[a-z]+(?=[.,;:)]|$)"
    ),
    "negated noun": r"\b(?:is|are|was|were|be) no (?!longer|more|less)[a-z]+|\bnothing\b",
    "private word": (
        r"\b(?:beside|anew|judg(?:e|es|ed|ing|ement)|taught|teach(?:es)?|ruler|tally|promises?|stretch(?:es)?|lanes?)\b"
    ),
    "metaphor": r"\b(?:stands? for itself|lies|rests on|told|asks? for|speaks?|says? so|handed)\b",
    "filler": r"\b(?:but for|so many|so much|as it is|as they are|whatever|or else)\b",
    "preposition at the end": r"\b(?:of|by|to|from|with|on|at|off|behind|beside)[.;]",
}
PATTERNS = {name: re.compile(pattern) for name, pattern in CONSTRUCTIONS.items()}
PREPOSITIONS = frozenset(
    {
        "of",
        "by",
        "beside",
        "as",
        "for",
        "in",
        "at",
        "per",
        "after",
        "before",
        "behind",
        "among",
        "than",
        "without",
        "within",
        "against",
        "between",
        "under",
        "above",
        "below",
    }
)
PARTICIPLES = frozenset(
    {"held", "drawn", "kept", "made", "known", "given", "told", "taken", "found", "said", "met", "fed", "judged"}
)
CODE_SPAN = re.compile(r"`[^`]*`")


@dataclass(frozen=True)
class Finding:
    """Place of a construction or name that the style guide excludes."""

    file: str
    line: int
    rule: str
    text: str


def check_text(text: str) -> list[str]:
    """Return the names of the constructions in a text, without its code spans."""
    plain = CODE_SPAN.sub("x", text)
    return [name for name, pattern in PATTERNS.items() if pattern.search(plain)]


def check_module(source: str, file: str) -> Iterator[Finding]:
    """Yield the findings in the docstrings and names of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            summary = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
            line = getattr(node, "lineno", 1)
            for rule in check_text(summary):
                yield Finding(file, line, rule, summary)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            first = node.name.strip("_").split("_")[0]
            if first in PREPOSITIONS or node.name.strip("_") in PARTICIPLES:
                yield Finding(file, node.lineno, "name of a function", node.name)


def check_page(text: str, file: str) -> Iterator[Finding]:
    """Yield the findings in the prose of a Markdown page."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif not fenced and not line.startswith("#"):
            for rule in check_text(line):
                yield Finding(file, number, rule, line.strip())


def check_repository(root: Path = ROOT) -> Iterator[Finding]:
    """Yield the findings in all modules and pages of the repository."""
    for folder in CODE:
        for path in sorted((root / folder).rglob("*.py")):
            yield from check_module(path.read_text(encoding="utf-8"), path.relative_to(root).as_posix())
    for path in list_pages(root):
        yield from check_page(path.read_text(encoding="utf-8"), path.relative_to(root).as_posix())


def list_pages(root: Path = ROOT) -> list[Path]:
    """Return the hand-written pages: docs without journal and decisions, and the README."""
    pages = [path for path in (root / "docs").rglob("*.md") if not {"decisions", "journal"} & set(path.parts)]
    return sorted([*pages, root / "README.md", *(root / "website" / "pages").glob("*.md")])


def read_allowed() -> dict[str, int]:
    """Return the allowed number of findings by file."""
    return tomllib.loads(ALLOWED.read_text(encoding="utf-8"))["findings"]


def compare_with_allowed(counts: Counter[str], allowed: dict[str, int]) -> list[str]:
    """Return one line for each file with more findings than allowed; a new file has none."""
    return [
        f"{file}: {count} findings, at most {allowed.get(file, 0)} allowed"
        for file, count in sorted(counts.items())
        if count > allowed.get(file, 0)
    ]


def lower_allowed(counts: Counter[str], allowed: dict[str, int]) -> dict[str, int]:
    """Return the allowed numbers, lowered to the present ones; files without findings are omitted, none is added."""
    lowered = {file: min(count, counts[file]) for file, count in allowed.items()}
    return {file: count for file, count in lowered.items() if count}


def main() -> int:
    """Print the findings above the allowed number; with ``--write`` lower the allowed numbers."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--write", action="store_true", help="lower the numbers in allowed.toml to the present ones")
    parser.add_argument("--list", metavar="FILE", help="print all findings of a file")
    arguments = parser.parse_args()
    findings = list(check_repository())
    counts = Counter(finding.file for finding in findings)
    if arguments.list:
        for finding in findings:
            if finding.file == arguments.list:
                print(f"{finding.file}:{finding.line}: {finding.rule}: {finding.text}")
        return 0
    if arguments.write:
        lowered = lower_allowed(counts, read_allowed())
        rows = "".join(f'"{file}" = {count}\n' for file, count in sorted(lowered.items()))
        ALLOWED.write_text(f"# Findings of make english by file; `english.py --write` lowers them.\n[findings]\n{rows}")
    print(f"{len(findings)} findings in {len(counts)} files: {dict(Counter(f.rule for f in findings).most_common())}")
    excess = compare_with_allowed(counts, read_allowed())
    for line in excess:
        print(f"{line}; python tests/language/english.py --list {line.partition(':')[0]} shows them")
    return 1 if excess else 0


if __name__ == "__main__":
    sys.exit(main())
