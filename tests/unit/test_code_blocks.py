"""Every Python block of README and docs/ runs, page by page and in order; other blocks are read as what they are.

A block is left out by a comment above it, which says why: ``<!-- not run: REASON -->``.
"""

import json
import re
import tomllib
from pathlib import Path

import pytest
from page_grounds import SHORTER, ground_of

from edp_site import commands, markdown

ROOT = Path(__file__).parents[2]
FOLDERS = tuple(ROOT / "docs" / name for name in ("", "explanation", "howto", "reference", "tutorials"))
PAGES = [ROOT / "README.md", *(page for folder in FOLDERS for page in sorted(folder.glob("*.md")))]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
QUICK = ("files", "statistics", "large_stores", "deploy_onnx", "repair_logs")
"""Pages whose blocks take seconds; those of the others run with the slow tests."""
ELSEWHERE = ("README", "python")
"""Pages that tests/examples/test_python_page.py runs."""
PROGRAMS = (".", ".venv/bin/jupyter", ".venv/bin/pip", "cmake", "colcon", "export", "pip", "ray", "ros2", "source")
"""Programs of others, and words of the shell, that a page may use; what they make of the rest is theirs."""
LANGUAGES = {"python", "sh", "toml", "json", "c", "matlab", "text", ""}
_NOT_RUN = re.compile(r"<!-- not run: (.{20,}) -->\s*$")


def fences_of(page: Path, language: str) -> list[markdown.Fence]:
    """Blocks of a language that are not left out."""
    lines = TEXTS[page].splitlines()
    found = [fence for fence in markdown.fences(TEXTS[page]) if fence.language == language]
    return [fence for fence in found if not _NOT_RUN.search("\n".join(lines[: fence.line - 2]))]


def pages_with(language: str) -> list[Path]:
    return [page for page in PAGES if fences_of(page, language)]


RUN_HERE = [
    pytest.param(page, marks=() if page.stem in QUICK else (pytest.mark.slow, pytest.mark.timeout(1200)), id=page.stem)
    for page in pages_with("python")
    if page.stem not in ELSEWHERE
]


@pytest.mark.long
@pytest.mark.parametrize("page", RUN_HERE)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_python_blocks_run_in_order(page, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page", **ground_of(page, tmp_path, request)}
    for fence in fences_of(page, "python"):
        code = fence.code
        for long, short in SHORTER.get(page.stem, {}).items():
            code = code.replace(long, short)
        exec(compile("\n" * (fence.line - 1) + code, page.name, "exec"), names)


def test_what_is_shortened_is_on_the_page():
    for stem, pairs in SHORTER.items():
        texts = [text for page, text in TEXTS.items() if page.stem == stem]
        for long in pairs:
            assert any(long in text for text in texts), f"{stem}: {long}"


def test_blocks_are_of_known_languages():
    for page, text in TEXTS.items():
        assert {fence.language for fence in markdown.fences(text)} <= LANGUAGES, page.name


@pytest.mark.parametrize(("language", "parse"), [("toml", tomllib.loads), ("json", json.loads)])
def test_blocks_of_settings_can_be_read(language, parse):
    pages = pages_with(language)
    assert pages
    for page in pages:
        for fence in fences_of(page, language):
            assert parse(fence.code), f"{page.name}, line {fence.line}"


def test_every_line_of_a_shell_block_names_what_is_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    seen = set()
    for page in pages_with("sh"):
        for fence in fences_of(page, "sh"):
            for line in fence.code.replace("\\\n", " ").splitlines():
                words = line.split("#")[0].split()
                if not words:
                    continue
                seen.add(words[0])
                problem = f"{page.name}, line {fence.line}: {line}"
                if words[0] == "edp":
                    assert commands.problems_of(line, commands.commands()) == [], problem
                elif words[0] == "make":
                    assert {word for word in words[1:] if "=" not in word} <= targets, problem
                elif words[0] not in PROGRAMS and words[:2] != ["python", "-m"]:
                    script = words[1] if words[0] == "python" else words[0]
                    assert (ROOT / script).is_file(), problem
    assert {"edp", "make"} <= seen
