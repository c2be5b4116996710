"""Measured figures and goals of the documentation, recomputed from the results that the benchmarks kept."""

from __future__ import annotations

import ast
import json
import re
import shutil
import sys
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

from edp_site import results

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
ARCHIVE = results.read_archive(BENCHMARKS / "archive.toml")
UNITS = r"(?:%|mm/s|mm|ms|s|min|h|GB|MB|kB|bar|degC|bytes|times|cycles|tasks)"
MEASURED = re.compile(rf"(?<![\w.,:-])(?:\d+\.\d+|\d+(?= ?{UNITS}(?![\w-])))")
"""Numbers of a text that look measured: a decimal number, or a whole number with a unit."""
REDUCTIONS = {"mean": fmean, "max": max, "min": min, "count": len}
PROGRAMS = re.compile(r"gcc|clang|valgrind|qemu-system-arm|arm-none-eabi-\w+")


@cache
def kept(name: str) -> Any:
    return json.loads((BENCHMARKS / "results" / f"{name}.json").read_text(encoding="utf-8"))


def value_of(source: str) -> str:
    """Return a value of a result as text; `docs/figures.toml` has the form of `source`."""
    place, _, form = source.rpartition(":")
    place, _, factor = place.partition("*")
    name, *keys = place.split("/")
    value = kept(name)
    path = "/".join(keys)
    while path:
        if isinstance(value, list) and path in REDUCTIONS:
            value, path = REDUCTIONS[path](value), ""
        elif isinstance(value, list):
            # The longest title: some verdicts begin with the title of another one.
            found = max(
                (one for one in value if path.startswith(f"{one['title']}/")), key=lambda one: len(one["title"])
            )
            value, path = found | {"ratio": found["value"] / found["target"]}, path.removeprefix(f"{found['title']}/")
        else:
            key = next(key for key in sorted(value, key=len, reverse=True) if f"{path}/".startswith(f"{key}/"))
            value, path = value[key], path.removeprefix(key).removeprefix("/")
    return format(value * float(factor or 1), form)


@dataclass(frozen=True)
class Claims:
    """What `docs/figures.toml` says of one page: sentence parts with figures, and numbers that are not measured."""

    figures: tuple[tuple[str, tuple[str, ...]], ...]
    stated: tuple[str, ...]


def claims(page: str) -> Claims:
    rows = tomllib.loads((ROOT / "docs" / "figures.toml").read_text(encoding="utf-8"))
    figures = tuple((row["text"], tuple(row["values"])) for row in rows["figure"] if row["page"] == page)
    return Claims(figures, tuple(text for row in rows["stated"] if row["page"] == page for text in row["texts"]))


def plain(page: str) -> str:
    """Return the text of a page without code, link targets and line breaks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"```.*?```", " ", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", " ", text))
    return " ".join(text.split())


def unproven(text: str, page: Claims) -> list[str]:
    """Return the numbers of a text that look measured and belong to no row."""
    for pattern, values in page.figures:
        text = text.replace(pattern.format(*map(value_of, values)), " ")
    for part in page.stated:
        text = text.replace(part, " ")
    return [match[0] for match in MEASURED.finditer(text)]


def section(page: str) -> str:
    """Return the part of a page whose figures are held: the README after its code, and all of any other page."""
    text = plain(page)
    return text.split("## Measured")[1].split("## Documentation")[0] if page == "README.md" else text


PAGES = ["README.md", "docs/limits.md"]


@pytest.mark.parametrize("page", PAGES)
def test_figures_of_a_page_are_those_of_the_kept_results(page):
    text = plain(page)
    missing = [part for part in (p.format(*map(value_of, v)) for p, v in claims(page).figures) if part not in text]
    assert missing == []


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_no_measured_figure_without_a_source(page):
    assert unproven(section(page), claims(page)) == []


def test_a_figure_that_no_result_has_is_noticed():
    page = claims("docs/limits.md")
    assert unproven("It finds 76 % of the faults in 1.25 s, of 3 kinds", page) == ["76", "1.25"]


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.stem)
def test_a_page_names_scripts_that_are_there_or_the_commit_that_has_them(path):
    text = path.read_text(encoding="utf-8")
    parts = re.split(r"^(?=##)", text, flags=re.MULTILINE)
    archived = {one.script: one.place for one in ARCHIVE if not one.parts}
    for part in parts:
        named = set(re.findall(r"(?<!:)benchmarks/(\w+)\.py", part))
        gone = {name for name in named if not (BENCHMARKS / f"{name}.py").is_file()}
        assert gone <= set(archived), f"{path.name}: {gone - set(archived)}"
        general = "git show {}:benchmarks/NAME.py".format(ARCHIVE[0].place.split(":")[0])
        assert general in part or [name for name in gone if f"git show {archived[name]}" not in part] == []
        results_named = re.findall(r"benchmarks/results/(\w+)\.json", part)
        named_results = [results.read_result(BENCHMARKS / "results" / f"{name}.json") for name in results_named]
        places = {one.place for one in ARCHIVE for result in named_results if one.covers(result)}
        assert [place for place in places if f"git show {place}" not in part] == [], part.splitlines()[0]


def benchmark(name: str) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        return __import__(name)


@pytest.fixture(autouse=True)
def forget_benchmarks():
    yield
    for name in {path.stem for path in BENCHMARKS.glob("*.py")} & set(sys.modules):
        del sys.modules[name]


def test_a_verdict_with_interchanged_figures_is_refused():
    with pytest.raises(ValueError, match="interchange the figures"):
        benchmark("common").verdict("a tick against the reference", 24.8, 1.5, ">= 10", "ms")


def called_programs(path: Path, names: frozenset[str] = frozenset()) -> set[str]:
    """Return the programs of the system that a benchmark names, also in what it imports from other benchmarks.

    Args:
        path: source.
        names: of what is imported from it, with what that needs; all if empty.
    """
    body = ast.parse(path.read_text(encoding="utf-8")).body
    if names:
        bound = {name: node for node in body for name in bindings(node)}
        needed, open_names = set(), set(names)
        while open_names := open_names & set(bound) - needed:
            needed |= open_names
            used = [node for name in open_names for node in ast.walk(bound[name]) if isinstance(node, ast.Name)]
            open_names = {node.id for node in used}
        imports = [node for node in body if isinstance(node, ast.ImportFrom)]
        body = [node for node in imports if needed & bindings(node)] + [bound[name] for name in needed]
    nodes = [found for node in body for found in ast.walk(node)]
    texts = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    called = {text for text in texts if PROGRAMS.fullmatch(text)}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (BENCHMARKS / f"{node.module}.py").is_file():
            part = BENCHMARKS / f"{node.module}.py"
            called |= called_programs(part, frozenset(alias.name for alias in node.names))
    return called


def bindings(node: ast.stmt) -> set[str]:
    """Return the names that a statement of a module binds."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {found.id for target in targets if target for found in ast.walk(target) if isinstance(found, ast.Name)}


def is_benchmark(path: Path) -> bool:
    return "__main__" in path.read_text(encoding="utf-8")


def leaves_parts_out(path: Path) -> bool:
    """Return whether a benchmark looks for its programs itself and runs without them."""
    return "shutil.which" in path.read_text(encoding="utf-8")


NEEDING = [
    p for p in sorted(BENCHMARKS.glob("*.py")) if is_benchmark(p) and called_programs(p) and not leaves_parts_out(p)
]


def test_most_benchmarks_of_compiled_code_are_known_by_their_programs():
    assert len(NEEDING) >= 9


@pytest.mark.parametrize("path", NEEDING, ids=lambda path: path.stem)
def test_a_benchmark_ends_cleanly_without_its_programs(path, monkeypatch, capsys):
    found = benchmark(path.stem)
    assert called_programs(path) == set(found.PROGRAMS)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setattr(sys, "argv", [path.name, "--quick"])
    found.main()
    assert capsys.readouterr().out.startswith(f"skipped: {found.PROGRAMS[0]}")


DEFINITIONS = {
    "explanation/simulator": {"Validation"},
    "explanation/thesis": {"Search space"},
    "howto/deploy_c": {"Limits"},
}
"""Sections whose tables have numbers that define something and were not measured."""
MEASURED_PAGES = [
    page.relative_to(ROOT / "docs").with_suffix("").as_posix()
    for folder in ("explanation", "howto")
    for page in sorted((ROOT / "docs" / folder).glob("*.md"))
]


def numeric_rows(part: str) -> list[str]:
    return [row for row in re.findall(r"^\|.*\|$", part, flags=re.MULTILINE) if re.search(r"\| *-?\d+\.\d", row)]


@pytest.mark.parametrize("page", MEASURED_PAGES)
def test_a_section_with_measured_tables_names_its_file_or_says_that_none_was_kept(page):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    parts = [part for part in re.split(r"^(?=##)", text, flags=re.MULTILINE) if len(numeric_rows(part)) > 1]
    for part in parts:
        title = part.splitlines()[0]
        named = re.findall(r"benchmarks/results/(\w+)\.json", part)
        assert named or "Not kept**" in part or title.lstrip("# ") in DEFINITIONS.get(page, ()), f"{page}: {title}"
        assert [name for name in named if not (BENCHMARKS / "results" / f"{name}.json").is_file()] == []
