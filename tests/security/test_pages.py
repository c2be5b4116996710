"""Pages run nothing but their own script and fetch nothing, whatever the names in them."""

import ast
import re
from importlib import resources
from pathlib import Path

import pytest

from edp.report.common.templates import json_text, template

REPORT = Path(str(resources.files("edp.report")))
ASSETS = REPORT / "assets"
PAGES = sorted(entry.name for entry in ASSETS.iterdir() if entry.name.endswith(".html.jinja"))
TESTS = Path(__file__).parents[1]
HOSTILE = ["</script><script>alert(1)</script>", "<!--<script>", "--></script>", "]]>", "&lt;/script&gt;"]


@pytest.mark.parametrize("name", PAGES)
def test_every_page_begins_with_the_head_of_all_pages(name):
    text = ASSETS.joinpath(name).read_text(encoding="utf-8")
    begin = re.search(r"\{(?:\{|% call) head\(", text)
    assert begin is not None
    assert "<" not in re.sub(r"\{% macro .*\{% endmacro %\}", "", text[: begin.start()], flags=re.DOTALL)
    assert "<head>" not in text
    assert "http-equiv" not in text


def test_the_head_has_a_policy_before_anything_that_runs():
    head = str(template("macros.jinja").module.head("a<b", "p{}"))
    policy = head[: head.index("<style")]
    assert 'http-equiv="Content-Security-Policy"' in policy
    for rule in ("default-src 'none'", "form-action 'none'", "base-uri 'none'", "img-src data:"):
        assert rule in policy
    assert "http:" not in policy
    assert "https:" not in policy
    assert "a&lt;b" in policy


def test_every_page_is_opened_in_a_browser():
    """A kind of page that no test opens in Chromium (`check_page`, `check_kind`) fails here."""
    templates = {name: ASSETS.joinpath(name).read_text(encoding="utf-8") for name in PAGES if name != "page.html.jinja"}
    kinds = {re.search(r'head\(\w+ ~ ": ([^"]+)"', text)[1] for text in templates.values()}
    for path in REPORT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Page":
                kinds |= {key.value.value for key in node.keywords if key.arg == "kind"}
    opened = set()
    for path in TESTS.rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
            if called in ("check_page", "check_kind") and getattr(node.args[0], "id", "") == "browser":
                opened.add(node.args[2 if called == "check_page" else 1].value)
    assert opened == kinds


def test_all_pages_are_looked_at():
    assert {"animation.html.jinja", "live.html.jinja", "page.html.jinja"} <= set(PAGES)


@pytest.mark.parametrize("name", HOSTILE)
def test_data_in_a_page_ends_no_script(name):
    text = str(json_text({"name": name, name: [name]}))
    assert "<" not in text
    assert ">" not in text
    assert "&" not in text
