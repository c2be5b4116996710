"""Pages hold: links lead somewhere, pages are in the navigation, commands, options and settings exist, code compiles.

Needs no builder of the site.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
from pathlib import Path

import pytest
import yaml

import edp
import edp_site.commands as site_commands
from edp_site import diagrams, journal, markdown, notebooks, parts, python_api, result_files, settings_keys
from edp_site.built import problems_of, seal
from edp_site.links import broken_links
from edp_site.stage import builder_settings, stage

ROOT = Path(__file__).parents[2]
HAND_WRITTEN = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "website" / "pages").glob("*.md")],
    key=lambda page: page.as_posix(),
)
HISTORY = ("decisions", "journal")
"""Folders of pages that keep commands as they were at their date."""
PRESENT = [page for page in HAND_WRITTEN if page.name != "CHANGELOG.md" and page.parent.name not in HISTORY]
RUN_ELSEWHERE = {"README.md", "python.md"}
"""Their Python is run by tests/examples/test_python_page.py."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def staged(tmp_path_factory) -> Path:
    """The pages of the site, laid out as for the builder."""
    out = tmp_path_factory.mktemp("site")
    stage(out)
    return out / "pages"


def navigation(settings: str) -> list[str]:
    """Return the pages in the menu of the builder's settings, in its order."""

    def walk(entry: object) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        inner = entry.values() if isinstance(entry, dict) else entry
        return [page for item in inner for page in walk(item)]

    return walk(yaml.safe_load(settings)["nav"])


def test_links_and_anchors_of_the_repository_lead_somewhere():
    pages = [page for page in HAND_WRITTEN if page.parent != ROOT / "website" / "pages"]
    assert broken_links(pages, ROOT) == []


def test_links_and_anchors_of_the_staged_site_lead_somewhere(staged):
    pages = sorted(staged.rglob("*.md"))
    assert len(pages) > len(HAND_WRITTEN)
    assert broken_links(pages, staged) == []


def test_every_page_is_in_the_navigation_and_every_entry_is_a_page(staged):
    written = navigation((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    shown = navigation(builder_settings(ROOT / "mkdocs.yml", staged))
    assert len(shown) == len(set(shown))
    pages = {page.relative_to(staged).as_posix() for page in staged.rglob("*.md")}
    listed_elsewhere = {page for page in pages if page.startswith(("decisions/0", "files/", "journal/", "results/"))}
    missing = pages - set(shown) - listed_elsewhere
    assert not missing, f"add to nav of mkdocs.yml: {sorted(missing)}"
    assert {page for page in written if "*" not in page} <= pages


@pytest.mark.parametrize("folder", ["decisions", "journal"])
def test_every_decision_and_every_finding_is_listed(staged, folder):
    text = (staged / folder / "index.md").read_text(encoding="utf-8")
    for path in (ROOT / "docs" / folder).glob("*.md"):
        assert f"({path.name})" in text


def test_a_decision_without_a_status_is_refused(tmp_path):
    (tmp_path / "0001-a.md").write_text("# 0001. A\n\n## Context\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"0001-a\.md: got no status line"):
        journal.decisions_page(tmp_path)


def test_entries_of_pages_that_are_not_there_are_left_out(tmp_path):
    (tmp_path / "a.md").write_text("# A", encoding="utf-8")
    given = "docs_dir: x\nsite_dir: y\nnav:\n  - A: a.md\n  - Group:\n      - B: b.md\n      - a.md\n"
    (tmp_path / "mkdocs.yml").write_text(given, encoding="utf-8")
    text = builder_settings(tmp_path / "mkdocs.yml", tmp_path)
    assert text == "docs_dir: pages\nsite_dir: site\nnav:\n  - A: a.md\n  - Group:\n      - a.md\n"


def test_a_menu_entry_with_a_star_lists_the_other_pages_of_its_folder(tmp_path):
    (tmp_path / "howto").mkdir()
    for name in ("first", "a", "index"):
        (tmp_path / "howto" / f"{name}.md").write_text("# A", encoding="utf-8")
    given = "nav:\n  - First: howto/first.md\n  - How-to: howto/*.md\n  - howto/*.md\n  - Missing: other/*.md\n"
    (tmp_path / "mkdocs.yml").write_text(given, encoding="utf-8")
    text = builder_settings(tmp_path / "mkdocs.yml", tmp_path)
    group = "  - How-to:\n      - howto/index.md\n      - howto/a.md\n"
    assert text == f"nav:\n  - First: howto/first.md\n{group}  - howto/index.md\n  - howto/a.md\n"


def test_every_public_name_is_in_the_reference_with_its_members_and_a_text(staged):
    text = (staged / "reference" / "python.md").read_text(encoding="utf-8")
    titles = {heading.text.strip("`") for heading in markdown.headings(text)}
    for name in edp.__all__:
        assert f"edp.{name}" in titles
        value = getattr(edp, name)
        if inspect.isclass(value):
            assert inspect.getdoc(value), name
            for member, of in python_api.members(value):
                assert f"{name}.{member}" in titles
                assert inspect.getdoc(of), f"{name}.{member} has no docstring"
    assert {f"edp.testing.{name}" for name in edp.testing.__all__} <= titles
    assert "## Training and evaluation {" in text, "the introduction of docs/reference/python.md"


def test_every_result_file_and_key_is_in_the_reference(staged):
    text = (staged / "reference" / "files.md").read_text(encoding="utf-8")
    classes = result_files.result_files()
    assert {"AutoChoice", "ControlFile", "MonitorRunFile", "ScoresFile"} <= {cls.__name__ for cls in classes}
    for cls in classes:
        section = text.split(f"\n## `{cls.NAME}`")[1].split("\n## ")[0]
        assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == [entry.name for entry in dataclasses.fields(cls)]
    for name in set(re.findall(r"\[`(\w+)`\]\(#\w+\)", text)):
        assert f"\n### `{name}`" in text, name


def test_faults_controllers_machines_and_soils_are_in_the_reference(staged):
    text = (staged / "reference" / "parts.md").read_text(encoding="utf-8")
    assert "| 0.3, 1, 3, 10 L/min | 0 to 100 L/min | machine |" in text
    for name in ("nmpc", "internal_leak", "M22", "sandy_loam"):
        assert f"\n| `{name}` |" in text


def test_the_diagrams_are_those_that_the_script_draws():
    for name, draw in diagrams.FIGURES.items():
        shown = (ROOT / "docs" / "images" / f"{name}.svg").read_text(encoding="utf-8")
        assert shown == draw(), f"{name}: PYTHONPATH=website python -m edp_site.diagrams"


def test_every_command_and_option_is_in_the_reference(staged):
    text = (staged / "reference" / "commands.md").read_text(encoding="utf-8")
    sections = dict(part.partition("\n")[::2] for part in re.split(r"^## ", text, flags=re.MULTILINE))
    sections = {title.partition(" {")[0]: section for title, section in sections.items()}
    for words, command in site_commands.commands().items():
        if words and not hasattr(command.parsed, "commands"):
            section = sections[" ".join(("edp", *words))]
            assert all(f"`{name}`" in section for name in command.options if name.startswith("-"))


def test_every_registered_part_is_in_the_reference(staged):
    text = (staged / "reference" / "parts.md").read_text(encoding="utf-8")
    known = parts.registries()
    assert {"edp.networks.blocks.base.BLOCKS", "edp.logs.formats.base.FORMATS"} <= set(known)
    for place, registry in known.items():
        section = text.split(f"Registry `{place}`.")[1].split("\n## ")[0]
        assert all(f"| `{name}` |" in section for name in registry), place


@pytest.mark.parametrize("page", PRESENT, ids=name_of)
def test_commands_options_and_settings_on_the_page_exist(page):
    known = site_commands.commands()
    problems = []
    for number, line in site_commands.command_lines(page.read_text(encoding="utf-8")):
        words, changes = site_commands.settings_of(line)
        wrong = site_commands.problems_of(line, known)
        wrong += [f"there is no setting '{key}'" for key in settings_keys.unknown_keys(words, changes)]
        problems += [f"line {number}: {problem}" for problem in wrong]
    for number, code in markdown.code_spans(page.read_text(encoding="utf-8")):
        if code.startswith("--set "):
            _, changes = site_commands.settings_of(f"edp x {code}")
            problems += [f"line {number}: no setting '{key}'" for key in settings_keys.unknown_keys((), changes)]
    assert problems == []


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=name_of)
def test_python_on_the_page_compiles(page):
    for fence in markdown.fences(page.read_text(encoding="utf-8")):
        if fence.language == "python":
            compile(fence.code, f"{name_of(page)}, line {fence.line}", "exec")


@pytest.mark.slow
def test_python_of_the_page_on_streaming_shows_equal_results(tmp_path, monkeypatch, capsys):
    page = ROOT / "docs" / "explanation" / "streaming.md"
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": "page"}
    for fence in markdown.fences(page.read_text(encoding="utf-8")):
        if fence.language == "python":
            exec(compile(fence.code, page.name, "exec"), space)
    assert float(capsys.readouterr().out) < 1e-5  # of values near 1e-2; single samples and one call differ by rounding


def test_messages_of_the_page_on_troubleshooting_are_those_of_the_code():
    page = (ROOT / "docs" / "howto" / "troubleshooting.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([^`]+)` \|", page.split("## By message")[1], re.MULTILINE)
    source = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "src" / "edp").rglob("*.py"))
    assert len(rows) > 10
    assert [row for row in rows if row not in source] == []


def test_links_that_lead_nowhere_are_told(tmp_path):
    (tmp_path / "b.md").write_text("# B\n\n## Two `words`, more\n", encoding="utf-8")
    text = (
        "[a](b.md) [b](b.md#two-words-more) [c](b.md#none) [d](none.md) [e](../out.md) ![f](none.png) `[g](none.md)`\n"
        '<img src="none.gif"> [h](#a) [i](#none) [j](https://example.org/none)\n\n# A\n\n```\n[k](none.md)\n```\n'
    )
    (tmp_path / "a.md").write_text(text, encoding="utf-8")
    found = [problem.split(": ")[1] for problem in broken_links([tmp_path / "a.md"], tmp_path)]
    assert found == ["b.md#none", "none.md", "../out.md", "none.png", "#none", "none.gif"]


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("edp train logs --out run", None),
        ("edp search logs --out dir", None),
        ("edp monitor fit logs --out dir  # a remark --none", None),
        ("edp train logs --out run && other --none", None),
        ("edp trian logs", "there is no command 'trian'"),
        ("edp train logs --uot run", "'edp train' has no option '--uot'"),
        ("edp monitor fti logs", "'edp monitor' has no command 'fti'"),
        ("edp search status dir --out x", "'edp search status' has no option '--out'"),
        ("edp train 'logs", "'edp train 'logs' cannot be read"),
    ],
)
def test_command_lines_that_cannot_be_are_told(line, problem):
    found = site_commands.problems_of(line, site_commands.commands())
    assert len(found) == (problem is not None)
    assert problem is None or found[0].startswith(problem)


@pytest.mark.parametrize(
    ("command", "change", "exists"),
    [
        ("train", "training.epochs=3", True),
        ("train", "model.backbone.units=3", True),
        ("train", "model.backbone.kind=gru", True),
        ("train", "auto.time_budget_min=3", True),
        ("train", "training.epoch=3", False),
        ("train", "twin.kind=greybox", False),
        ("twin", "twin.kind=greybox", True),
        ("twin", "twin.kinds=greybox", False),
        ("train logs --focus simulation", "twin.kind=greybox", True),
        ("train logs --focus simulation", "training.epochs=3", False),
        ("train finetune", "finetune.single_phase_epochs=3", True),
        ("train finetune", "finetune.round=3", False),
        ("calibrate", "twin.kind=greybox", True),
        ("loop run", "controller.blocks=[4]", True),
        ("loop tune", "controller.block=[4]", False),
        ("export", "opset=11", True),
        ("simulate", "limit.moments=60", True),
        ("simulate", "limit.moment=60", False),
        ("", "controller.blocks=[4]", True),
    ],
)
def test_settings_that_do_not_exist_are_told(command, change, exists):
    assert (settings_keys.unknown_keys(tuple(command.split()), [change]) == []) == exists


def test_a_built_page_is_held_to_its_links_and_to_loading_nothing(tmp_path):
    head = "<html lang='en'><head><title>t</title>{}</head><body><h1 id='a'>a</h1>{}</body></html>"
    (tmp_path / "ok.html").write_text(head.format("", "<a href='#a'>x</a> <a href='https://example.org'>y</a>"))
    links = "<a href='none.html'>x</a> <a href='ok.html#b'>y</a> <img src='//example.org/p.png'>"
    (tmp_path / "bad.html").write_text(head.format("<link rel='stylesheet' href='https://example.org/s.css'>", links))
    (tmp_path / "s.css").write_text("a { background: url('https://example.org/b.png') }")
    assert problems_of(tmp_path) == [
        "bad.html: loads https://example.org/s.css",
        "bad.html: loads //example.org/p.png",
        "bad.html: a picture without a text: //example.org/p.png",
        "bad.html: none.html: there is no such file",
        "bad.html: ok.html#b: the page has no such anchor",
        "s.css: loads https://example.org/b.png",
    ]
    (tmp_path / "assets").mkdir()
    script = "load('https://cdn.example.org/m.js'); make('http://www.w3.org/2000/svg')"
    (tmp_path / "assets" / "m.js").write_text(script)
    assert [problem for problem in problems_of(tmp_path) if "could load" in problem] == [
        "assets/m.js: could load from https://cdn.example.org"
    ]
    assert seal(tmp_path) == 1
    assert (tmp_path / "assets" / "m.js").read_text() == "load('about:blank#/m.js'); make('http://www.w3.org/2000/svg')"
    assert not [problem for problem in problems_of(tmp_path) if "could load" in problem]
    (tmp_path / "plain.html").write_text("<html><body></body></html>")
    assert len([problem for problem in problems_of(tmp_path) if problem.startswith("plain.html")]) == 3


def test_a_figure_at_the_end_of_a_cell_is_a_picture_of_the_page(tmp_path):
    source = "import edp, numpy\ndata = edp.Recordings.from_arrays(numpy.zeros((50, 1)), rate_hz=100)\ndata.plot()"
    cell = {"cell_type": "code", "source": source, "outputs": [], "metadata": {}, "execution_count": None}
    (tmp_path / "a.ipynb").write_text(json.dumps({"nbformat": 4, "cells": [cell]}))
    ran = notebooks.run_notebook(tmp_path / "a.ipynb", tmp_path)
    (tmp_path / "a.ipynb").write_text(json.dumps(ran))
    page = notebooks.notebook_page(tmp_path / "a.ipynb", tmp_path / "pictures")
    assert "![What the cell above draws](pictures/a_1.png)" in page
    assert (tmp_path / "pictures" / "a_1.png").read_bytes().startswith(b"\x89PNG")


def test_a_notebook_runs_and_is_shown(tmp_path):
    cells = ["import matplotlib.pyplot as plt\nplt.plot([1, 2])\nprint('said')\n3 + 4", "1 / 0"]
    code = [{"cell_type": "code", "metadata": {}, "source": text, "outputs": []} for text in cells]
    book = {"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": code[:1]}
    (tmp_path / "a.ipynb").write_text(json.dumps(book), encoding="utf-8")
    ran = notebooks.run_notebook(tmp_path / "a.ipynb", tmp_path)
    (tmp_path / "a.ipynb").write_text(json.dumps(ran), encoding="utf-8")
    page = notebooks.notebook_page(tmp_path / "a.ipynb", tmp_path / "pictures")
    assert "```text\nsaid\n```" in page
    assert "```text\n7\n```" in page
    assert "(pictures/a_1.png)" in page
    assert (tmp_path / "pictures" / "a_1.png").read_bytes().startswith(b"\x89PNG")
    book["cells"] = code
    (tmp_path / "a.ipynb").write_text(json.dumps(book), encoding="utf-8")
    with pytest.raises(RuntimeError, match=r"a\.ipynb, code cell 2: ZeroDivisionError"):
        notebooks.run_notebook(tmp_path / "a.ipynb", tmp_path)
