"""Schema of benchmarks/results, the catalogue, and the pages of results that are made from both."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from edp_site import results

ROOT = Path(__file__).parents[2]
BENCHMARKS = ROOT / "benchmarks"
ALL = results.read_benchmarks(ROOT)
PAGE_OF = {page.script: page for page in ALL.pages}


@pytest.fixture
def verdicts_module(monkeypatch) -> Any:
    monkeypatch.syspath_prepend(BENCHMARKS)
    yield __import__("verdicts")
    sys.modules.pop("verdicts", None)


def verdict(**changes: Any) -> results.Verdict:
    whole = results.Verdict("a", "a", 1.0, 2.0, "ridge ARX", "mm", "lower", 0.6, False, "limits.md")
    return replace(whole, **changes)


@pytest.mark.parametrize("result", ALL.results, ids=lambda result: result.name)
def test_a_result_file_has_the_schema(result):
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", result.date)
    assert len({one.id for one in result.verdicts}) == len(result.verdicts)
    for one in result.verdicts:
        assert re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", one.id), one
        assert one.title
        assert one.direction in results.DIRECTIONS
        assert isinstance(one.target, float)
        assert (one.reference is None) == (not one.reference_name), one
        assert one.docs == PAGE_OF[result.script].docs


@pytest.mark.parametrize("result", ALL.results, ids=lambda result: result.name)
def test_a_result_file_agrees_with_the_catalogue(result, verdicts_module):
    for one in result.verdicts:
        row = {field.name: getattr(one, field.name) for field in fields(one)}
        assert verdicts_module.refresh(result.name, result.script, row) == row
        assert not (one.direction == "higher" and one.unit in costs(verdicts_module)), one


def costs(_: Any) -> frozenset[str]:
    """Return the units of which less is better."""
    common = __import__("common")
    sys.modules.pop("common", None)
    return common.COSTS  # type: ignore[no-any-return]


def test_a_script_has_one_page_with_short_notes_and_headlines_are_few():
    scripts = {result.script for result in ALL.results}
    assert {page.script for page in ALL.pages} == scripts
    assert len(ALL.pages) == len(scripts)
    assert [page.script for page in ALL.pages if len(page.notes.split()) > results.MAX_NOTE_WORDS] == []
    assert 0 < len(ALL.headlines) <= results.MAX_HEADLINES
    shown = [one for result in ALL.results for one in result.verdicts if one.headline]
    assert len(shown) == len(ALL.headlines)
    assert all(ALL.verdict(headline).headline for headline in ALL.headlines)


@pytest.mark.parametrize(
    ("changes", "is_met", "goal"),
    [
        ({}, True, "≤ 0.6 ×"),
        ({"target": 0.4}, False, "≤ 0.4 ×"),
        ({"direction": "higher", "target": 0.5}, True, "≥ 0.5 ×"),
        ({"reference": None, "reference_name": "", "target": 3.0}, True, "≤ 3 mm"),
        ({"reference": None, "reference_name": "", "target": 0.0, "value": 0.0}, True, "≤ 0 mm"),
        ({"value": None}, False, "≤ 0.6 ×"),
    ],
)
def test_a_verdict_is_met_by_its_figures(changes, is_met, goal):
    assert (verdict(**changes).is_met, verdict(**changes).goal) == (is_met, goal)


@pytest.mark.parametrize(
    ("title", "figures", "stored"),
    [
        ("MAE at k=10 against ridge_arx", (3.0, 9.0, "<= 0.6"), (9.0, "ridge ARX", "lower", 0.6)),
        ("stroke error", (3.0, 2.0, "<= 0.5"), (None, "", "lower", 1.0)),
        ("facts met", (14, 18, ">= 0.5"), (None, "", "higher", 9.0)),
        ("import cycles", (0, 0, "<= 0"), (None, "", "lower", 0.0)),
    ],
)
def test_a_run_stores_its_verdicts_with_the_names_of_the_catalogue(title, figures, stored, verdicts_module):
    measured = verdicts_module.Verdict(title, *figures, "1")
    (one,) = verdicts_module.stored_verdicts([measured], "demo_accuracy", "demo_accuracy")
    assert (one.reference, one.reference_name, one.direction, one.target) == stored
    assert one.value == figures[0]
    assert results.Verdict(**vars(one)).is_met == measured.is_met
    assert one.docs == PAGE_OF["demo_accuracy"].docs


def test_a_changed_kind_of_target_is_refused(verdicts_module):
    row = vars(verdict(title="stroke error"))
    with pytest.raises(ValueError, match="has another kind of target"):
        verdicts_module.refresh("demo_accuracy", "demo_accuracy", row)


@pytest.mark.parametrize("goal", ALL.goals, ids=lambda goal: goal.asked[:60])
def test_a_goal_that_was_asked_has_its_verdicts_or_a_reason(goal):
    assert sum(map(bool, (goal.result, goal.measured, goal.test))) == 1
    if goal.result:
        assert len(goal.verdicts) == len(ALL.outcomes(goal)) > 0
    if goal.test:
        assert (ROOT / goal.test).is_file()


def test_the_first_page_shows_every_headline_with_its_reference_and_outcome():
    page = results.results_page(ALL)
    for headline in ALL.headlines:
        one = ALL.verdict(headline)
        row = next(line for line in page.splitlines() if line.startswith(f"| [{headline.task}]("))
        assert f"| {results.figure(one.value)} " in row
        assert f"| {ALL.reference(headline)} |" in row
        assert one.reference_name in row
        assert not (headline.published or headline.reference_title) or ALL.reference(headline)
        assert ("**missed**" in row) == (not one.is_met)


def test_the_leaderboard_begins_with_headlines_and_has_every_verdict_and_goal():
    page = results.leaderboard_page(ALL)
    sections = re.findall(r"^## (.+)$", page, flags=re.MULTILINE)
    assert sections == ["Headlines", *(one.title for one in ALL.pages), "Goals that were asked"]
    for result in ALL.results:
        for one in result.verdicts:
            assert f"| {one.title} | {results.figure(one.value)}" in page
    for goal in ALL.goals:
        row = next(line for line in page.splitlines() if line.startswith(f"| {goal.asked} |"))
        assert ("**missed**" in row) == (not all(ALL.outcomes(goal)))


@pytest.mark.parametrize("page", ALL.pages, ids=lambda page: page.script)
def test_a_benchmark_page_has_its_results_and_where_its_script_is(page):
    text = results.benchmark_page(ALL, page)
    assert "/tmp/" not in text
    for result in ALL.find_by_script(page.script):
        section = text.split(f"\n## {result.name}\n")[1].split("\n## ")[0]
        assert result.date in section
        archived = [one for one in ALL.archive if one.covers(result)]
        place = re.search(r"`git show \w+:(\S+)`", section)
        assert bool(place) == bool(archived)
        assert archived or (BENCHMARKS / f"{page.script}.py").is_file()
        assert not place or place[1] == f"benchmarks/{page.script}.py"


def test_an_archived_script_is_gone_and_its_parts_have_results():
    for one in ALL.archive:
        assert (BENCHMARKS / f"{one.script}.py").is_file() == bool(one.parts), one
        assert one.reason
        assert [name for name in one.results if not (BENCHMARKS / "results" / f"{name}.json").is_file()] == []


def test_a_result_that_lacks_something_is_refused(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"command": "a.py", "date": "2026-01-01", "seed": 0}', encoding="utf-8")
    with pytest.raises(ValueError, match=r"a\.json has no 'verdicts'"):
        results.read_result(path)
    rows = {"command": "a.py", "date": "2026-01-01", "seed": 0, "verdicts": [{"name": "a", "ours": 1.0}]}
    path.write_text(json.dumps(rows), encoding="utf-8")
    with pytest.raises(ValueError, match="got a verdict with"):
        results.read_result(path)
