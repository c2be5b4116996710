"""The built site: no broken link, nothing from elsewhere, no serious finding of axe-core, usable on a phone.

Slow, and skipped where the builder (`make docs` installs it in .venv-docs) or a browser is not installed.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from browser import chromium, opened

from edp_site import browser, built, notebooks
from edp_site.stage import stage

ROOT = Path(__file__).parents[2]
BUILDER = ROOT / ".venv-docs" / "bin" / "zensical"
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
MOST_BYTES = 200_000
VISITED = (
    "index",
    "tutorials/index",
    "howto/index",
    "explanation/which_model",
    "howto/troubleshooting",
    "settings",
    "reference/commands",
    "gallery",
)
RESULTS = ("results", "results/monitor", "leaderboard", "journal/index", "decisions/index")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    if not BUILDER.exists():
        pytest.skip("the builder of the site is not installed: `make docs` installs it")
    out = tmp_path_factory.mktemp("built")
    stage(out)
    call = [str(BUILDER), "build", "--clean", "--strict", "--config-file", "mkdocs.yml"]
    made = subprocess.run(call, cwd=out, capture_output=True, text=True, timeout=240)
    assert made.returncode == 0, made.stdout + made.stderr
    assert built.seal(out / "site") > 0
    built.search_from_files(out / "site")
    return out / "site"


def pages_of(site: Path) -> list[str]:
    return [f"{name}.html" for name in VISITED + RESULTS] + [f"tutorials/{path.stem}.html" for path in NOTEBOOKS[:1]]


@pytest.fixture(scope="module")
def axe() -> Path:
    found = next((ROOT / ".venv-docs").rglob("axe.min.js"), None)
    if found is None or browser.browser() is None:
        pytest.skip("axe-core or Chromium is not installed: `make docs` and `make system-packages` install them")
    return found


@pytest.mark.slow
def test_links_of_the_built_site_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site):
    assert built.problems_of(site) == []


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "width"), [("default", 1280), ("slate", 1280), ("default", 390)])
def test_pages_are_accessible_load_nothing_from_elsewhere_and_fit_the_window(site, axe, scheme, width):
    visits = browser.visit(site, pages_of(site), axe, scheme, width)
    assert [visit.page for visit in visits] == pages_of(site)
    assert [finding for visit in visits for finding in visit.serious()] == []
    assert [(visit.page, visit.elsewhere) for visit in visits if visit.elsewhere] == []
    assert [(visit.page, visit.wide) for visit in visits if visit.wide > 0] == []


@pytest.mark.slow
def test_the_journal_is_filtered_by_tag(site):
    executable = chromium()
    if executable is None:
        pytest.skip("no Chromium; `make system-packages` installs it")
    script = """
      const choice = document.querySelector(".edp-filter select");
      choice.value = "fleet";
      choice.dispatchEvent(new Event("change"));
      const tagged = (row) => row.cells[2].textContent.split(", ").includes("fleet");
      [...document.querySelectorAll("tbody tr")].map((row) => [tagged(row), row.hidden]);
    """
    with opened(executable) as page:
        page.open(site / "journal" / "index.html")
        rows = page.run(script)
    assert {hidden for _, hidden in rows} == {True, False}
    assert all(tagged != hidden for tagged, hidden in rows)


@pytest.mark.slow
def test_the_search_finds_a_page_and_loads_nothing_from_elsewhere(site, axe):
    (visit,) = browser.visit(site, ["index.html"], axe, words="feedback port")
    assert any("which_model.html" in link for link in visit.words)
    assert visit.elsewhere == []


@pytest.mark.slow
def test_the_search_works_from_files_too(site):
    executable = chromium()
    if executable is None:
        pytest.skip("no Chromium; `make system-packages` installs it")
    script = browser.SEARCH + "search('feedback port')"
    with opened(executable) as page:
        page.open(site / "index.html")
        assert any("which_model.html" in link for link in page.run(script))
        assert page.complaints() == []
        assert page.requests() == []


@pytest.mark.slow
def test_a_page_that_is_bad_is_told(axe, tmp_path):
    text = (
        "<html><head><title>t</title></head><body><img src='a.png'><p style='color:#ccc;background:#fff'>pale</p>"
        "<script src='http://127.0.0.2:9/none.js'></script><div style='width:3000px'>wide</div></body></html>"
    )
    (tmp_path / "bad.html").write_text(text, encoding="utf-8")
    (visit,) = browser.visit(tmp_path, ["bad.html"], axe)
    assert {"color-contrast", "html-has-lang", "image-alt"} <= {one["id"] for one in visit.violations}
    assert visit.serious()
    assert any("127.0.0.2" in name for name in visit.elsewhere)
    assert visit.wide > 1000


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_what_is_kept_of_it_is_small(path, tmp_path):
    if path.stem == "plant_model":
        pytest.importorskip("gymnasium", reason="the loop of this tutorial needs the extra `control`")
    if path.stem == "csv_to_c" and not (shutil.which("cmake") and shutil.which("cc")):
        pytest.skip("no cmake, or no C compiler")
    kept = notebooks.read_notebook(path)
    ran = notebooks.run_notebook(path, tmp_path)
    assert path.stat().st_size <= MOST_BYTES
    for cell, again in zip(kept["cells"], ran["cells"], strict=True):
        if cell["cell_type"] == "code":
            kinds = [output["output_type"] for output in again["outputs"]]
            assert [output["output_type"] for output in cell["outputs"]] == kinds


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_tutorial_was_run_and_has_words_code_and_figures(path):
    cells = notebooks.read_notebook(path)["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert path.stat().st_size <= MOST_BYTES
    pictures = [o for cell in code for o in cell["outputs"] if "image/png" in o.get("data", {})]
    words = sum(len(notebooks.source_of(cell).split()) for cell in cells if cell["cell_type"] == "markdown")
    assert len(code) >= 6
    assert len(pictures) >= 3
    assert 350 <= words <= 1000
    assert not re.search(r"/(?:tmp|home|work|root)/", path.read_text(encoding="utf-8"))
