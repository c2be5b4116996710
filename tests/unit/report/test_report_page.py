import json
import re
from html.parser import HTMLParser

import pytest
from browser import check_page
from page_text import check_text

from edp.errors import StorageError
from edp.report import build_report
from edp.report.run.facts import MAKERS, read_facts
from edp.report.run.page import build_run_page
from edp.report.run.tables import comparison_tables
from edp.storage import write_json

pytestmark = pytest.mark.long

OWN = ("Boom cylinder", "Stick cylinder", "Bucket cylinder", "Cylinder velocities", "excavator")
"""Names of parts in the data of the run that `conftest.py` writes."""
LOADS = {"src", "href", "srcset", "data", "poster", "action", "formaction", "background"}


class Page(HTMLParser):
    """Tags, attributes that load something, visible text, and the figures' JSON."""

    def __init__(self, text):
        super().__init__()
        self.loads, self.tags, self.words, self.scripts, self.inside = [], [], [], [], None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.inside = tag
        self.loads += [value for name, value in attributes if name in LOADS]
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.inside = None

    def handle_data(self, data):
        if self.inside == "script":
            self.scripts[-1] += data
        elif self.inside != "style":
            self.words.append(data)

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.words))


def test_the_page_is_one_file_that_loads_nothing(run_folder):
    path = build_report(run_folder)
    assert path == run_folder / "report.html"
    assert path.stat().st_size < 1.5e6
    text = path.read_text()
    page = Page(text)
    assert all(load.startswith("#") for load in page.loads)
    assert not {"link", "iframe", "img", "object", "embed"} & set(page.tags)
    assert "default-src 'none'" in text
    assert "@import" not in text.split("</style>")[0]
    assert text.count("const Figure = ") == 1
    assert sorted(path.name for path in run_folder.iterdir() if path.name.startswith(".")) == []


def test_the_page_says_the_verdict_and_every_section(run_folder):
    page = Page(build_run_page(read_facts(run_folder)).html())
    assert "At 100 ms ahead the network is off by" in page.text
    for heading in ("Against the baselines", "Prediction against truth", "Residuals", "Learning curves", "Footprint"):
        assert heading in page.text
    for name in ("Hybrid TCN-LSTM", "Ridge ARX", "Persistence", "hybrid_tcn_lstm", "edp train quick --seed 7"):
        assert name in page.text
    assert page.tags.count("main") == 1
    assert page.tags.count("h1") == 1


def test_every_figure_has_its_place(run_folder):
    text = build_run_page(read_facts(run_folder)).html()
    specs = json.loads(Page(text).scripts[1])
    assert len(specs) == 7
    for spec in specs:
        assert f'id="figure-{spec["name"]}"' in text
        for key in spec["controls"]:
            assert f'data-figure="{spec["name"]}" data-key="{key}"' in text


@pytest.mark.parametrize("name", list(MAKERS))
def test_a_missing_part_is_named_with_the_command_that_makes_it(run_folder, name):
    (run_folder / name).unlink()
    page = Page(build_run_page(read_facts(run_folder)).html())
    assert f"This run has no {name}" in page.text
    assert f"{MAKERS[name]} {run_folder}" in page.text


@pytest.mark.parametrize("kept", list(MAKERS))
def test_one_part_alone_makes_a_page(run_folder, kept):
    for name in MAKERS:
        if name != kept:
            (run_folder / name).unlink()
    assert "Learning curves" in Page(build_run_page(read_facts(run_folder)).html()).text


def test_a_run_that_stopped_in_its_first_epoch_makes_a_page(run_folder):
    (run_folder / "history.jsonl").write_text('{"epoch": 1, "train_lo')
    assert "holds no finished epoch" in Page(build_run_page(read_facts(run_folder)).html()).text


def test_names_from_files_cannot_become_markup(run_folder):
    evil = "</script><script>alert(1)</script><b>&"
    scores = json.loads((run_folder / "scores.json").read_text())
    scores["task"]["name"] = scores["models"]["ridge_arx"]["label"] = scores["targets"][0]["description"] = evil
    recordings = scores["models"]["network"]["recordings"]
    recordings[evil] = recordings.pop(next(iter(recordings)))
    write_json(run_folder / "scores.json", scores)
    (run_folder / "config.toml").write_text(f'name = "{evil}"')
    text = build_run_page(read_facts(run_folder), title=evil).html()
    page = Page(text)
    assert len(page.scripts) == 3
    assert "<script>alert" not in text
    assert evil in "".join(page.words)
    names = {trace["name"] for spec in json.loads(page.scripts[1]) for trace in spec["figure"]["data"]}
    assert not any("<" in name for name in names)


def test_output_and_title_can_be_chosen(run_folder, tmp_path):
    path = build_report(run_folder, output=tmp_path / "shown" / "page.html", title="Spring trials")
    assert path == tmp_path / "shown" / "page.html"
    assert "<title>Spring trials: report</title>" in path.read_text()


def test_unknown_keys_are_ignored_and_unscored_metrics_are_dashes(run_folder):
    scores = json.loads((run_folder / "scores.json").read_text())
    scores["models"]["persistence"]["integrated"] = {"10": {}}
    scores["models"]["persistence"]["overall"]["10"]["mean"]["r2"] = None
    write_json(run_folder / "scores.json", scores)
    table = comparison_tables(read_facts(run_folder))[0]
    r2 = [column.heading for column in table.columns].index("R²")
    assert next(row for row in table.rows if row[0] == "Persistence")[r2] == "–"


def test_the_table_marks_the_network_and_leads_with_the_longest_horizon(run_folder):
    tables = comparison_tables(read_facts(run_folder))
    assert [table.caption for table in tables] == ["100 ms ahead", "10 ms ahead", "50 ms ahead"]
    assert all(table.rows[place][0] == "Hybrid TCN-LSTM" for table in tables for place in table.marked)


def test_a_page_that_cannot_be_written_says_so(run_folder):
    with pytest.raises(StorageError, match="cannot"):
        build_report(run_folder, output=run_folder / "config.toml" / "report.html")


@pytest.mark.parametrize("missing", ["", "scores.json", "footprint.json"])
def test_the_text_of_the_page(run_folder, missing):
    if missing:
        (run_folder / missing).unlink()
    text = build_run_page(read_facts(run_folder), "Velocities").html().replace(str(run_folder), "RUN")
    check_text(text, f"run{missing and '_without_' + missing.split('.')[0]}")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, run_folder):
    check_page(browser, build_report(run_folder), "report", OWN)


@pytest.mark.processes
def test_choices_zoom_and_legend_work(browser, run_folder):
    browser.open(build_report(run_folder))
    browser.run("window.dispatchEvent(new Event('beforeprint'))")  # draws what is not in sight, too
    lines = "[...document.querySelectorAll('#figure-predictions path[stroke-linejoin]')].map(p => p.getAttribute('d'))"
    first = browser.run(lines)
    browser.run(
        "(() => { const s = document.querySelector('select[data-key=recording]'); s.selectedIndex = 1;"
        " s.dispatchEvent(new Event('change')); })()"
    )
    second = browser.run(lines)
    assert len(first) == len(second) > 3
    assert first != second
    button = "document.querySelector('#figure-predictions .figure-legend button')"
    browser.run(f"{button}.click()")
    assert len(browser.run(lines)) < len(second)
    assert browser.run(f"{button}.getAttribute('aria-pressed')") == "false"
    box = browser.run(
        "(() => { const s = document.querySelector('#figure-predictions .figure-stage svg');"
        " s.scrollIntoView({ behavior: 'instant' });"
        " const r = s.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()"
    )
    left, top, width, height = box
    for kind, share in (("mousePressed", 0.4), ("mouseMoved", 0.6), ("mouseReleased", 0.6)):
        browser.ask("Input.dispatchMouseEvent", type=kind, x=left + share * width, y=top + 0.2 * height, button="left",
                    buttons=1, clickCount=1)  # fmt: skip
    assert browser.run("!document.querySelector('#figure-predictions .figure-back').hidden")
    browser.run("document.querySelector('#figure-predictions .figure-back').click()")
    assert browser.run("document.querySelector('#figure-predictions .figure-back').hidden")
    browser.ask("Input.dispatchMouseEvent", type="mouseMoved", x=left + 0.5 * width, y=top + 0.2 * height)
    assert "Hybrid TCN-LSTM" in browser.run("document.querySelector('#figure-predictions .figure-tip').textContent")
    assert browser.complaints() == []


@pytest.mark.processes
def test_names_stay_text_in_the_drawing(browser, run_folder):
    evil = "</script><img src=x onerror=alert(1)><b>&"
    scores = json.loads((run_folder / "scores.json").read_text())
    scores["models"]["ridge_arx"]["label"] = scores["targets"][0]["description"] = evil
    write_json(run_folder / "scores.json", scores)
    page = build_report(run_folder)
    browser.open(page)
    browser.run("window.dispatchEvent(new Event('beforeprint'))")
    assert browser.run("document.querySelectorAll('img, main b').length") == 0
    assert evil[:20] in browser.run("document.querySelector('#figure-predictions').textContent")
    assert browser.complaints() == []


@pytest.mark.processes
def test_the_page_prints_every_figure(browser, run_folder, tmp_path):
    browser.open(build_report(run_folder))
    assert browser.printed(tmp_path / "page.pdf").stat().st_size > 20_000
    assert browser.run("document.querySelectorAll('.figure-stage svg').length") == 7
