"""The report of a study: whole, half done and broken, in both modes."""

import copy
import csv
import json
import random

import pytest
from browser import check_page
from page_text import check_text

from edp.errors import EdpError, StorageError
from edp.evaluation.study import NUMBERS, parse_study, read_study
from edp.report import write_study_page
from edp.report.common.interactive import plots
from edp.report.search.charts import study_charts
from edp.report.search.page import build_study_page, study_text
from edp.report.search.tables import identifiers, study_tables
from edp.report.search.views import PointView, arm_views, forests, front, point_views, top_of, tracks
from edp.report.search.words import caveats, decided, headline, missing, tiles, verdict
from edp.workflows.search.modules import MODULES

pytestmark = pytest.mark.long

PHASES = (
    "isolation",
    "calibration",
    "screening",
    "planning",
    "confirmation",
    "synthesis",
    "exploration",
    "compression",
)


def plots_of(facts):
    return plots(study_charts(facts))


def page_of(study):
    facts = parse_study(study)
    return build_study_page(facts, study_tables(facts)).html()


def figures_of(text):
    return {spec["name"]: spec for spec in json.loads(text.split('id="figures">')[1].split("</script>")[0])}


def test_everything_is_written_and_loads_nothing(sound, tmp_path):
    made = write_study_page(parse_study(sound), tmp_path / "report")
    text = made.page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "://" not in text.split("<script>")[0]
    assert set(figures_of(text)) == {"variance", "pareto", "confirmation", "screening", "history"}
    assert all(f'id="figure-{name}"' in text for name in figures_of(text))
    pictures = {path.name for path in made.pictures}
    names = (
        "variance",
        "pareto_parameters",
        "pareto_macs_tick",
        "effects_confirmation",
        "effects_screening",
        "history",
    )
    assert pictures == {f"{name}.{kind}" for name in names for kind in ("svg", "png")}
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in made.pictures if path.suffix == ".png")
    assert not any("mathdefault" in path.read_text() for path in made.pictures if path.suffix == ".svg")
    tables = {path.stem for path in made.tables}
    assert tables >= {"variance", "calibration", "modules", "selection", "identifiers", "holdout", "openings", "phases"}
    with (tmp_path / "report/tables/modules.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(MODULES)
    assert all(None not in row and None not in row.values() for row in rows)
    again = write_study_page(parse_study(sound), tmp_path / "again", pictures=False)
    assert again.pictures == ()
    assert [again.page.read_bytes(), again.text.read_bytes()] == [made.page.read_bytes(), made.text.read_bytes()]


def test_the_tables_hold_what_the_phases_found(sound):
    tables = study_tables(parse_study(sound))
    facts = {held["phase"]: held["facts"] for held in sound["decisions"]}
    arm = facts["isolation"]["arms"]["hybrid FG2"]
    row = next(row for row in tables["variance"].rows if row[:2] == ("Hybrid", "FG2"))
    assert row[2:] == tuple(held[key] for held in (arm["mae"], arm) for key in ("mean", "split", "seed"))
    modules = {row[0]: row for row in tables["modules"].rows}
    helps = next(held for held in facts["confirmation"]["evidence"] if held["module"] == "squeeze_excitation")
    assert modules["Squeeze-Excitation"][3] == pytest.approx(100 * helps["change"])
    assert modules["Squeeze-Excitation"][5:8] == (helps["p"], helps["adjusted"], helps["d_z"]["value"])
    assert modules["Squeeze-Excitation"][-1] == "confirmed"
    assert modules["Zoneout"][3:] == (None, None, None, None, None, "stopped")
    assert [row[0] for row in tables["modules"].rows][:2] == ["Cyl Gate Diagonal", "Temporal Diff"]
    short = identifiers(parse_study(sound))
    active = tables["holdout"].rows[0]
    assert active[1] == "none"
    assert active[2] == ", ".join(short[name] for name in facts["synthesis"]["modules"])
    size = facts["synthesis"]["costs"]["parameters"]
    assert f"{size:,.0f} (" in tables["holdout"].rows[1][2]
    assert tables["holdout"].rows[2][2] == f"{4e-6 * size:.4f}"
    counts = tables["phases"].rows
    assert counts[-1][1] == len(sound["history"]) == sum(row[1] for row in counts[:-1])


def test_the_thesis_mode_has_its_own_figures(thesis, tmp_path):
    facts = parse_study(thesis)
    shown = {view.key: view for view in forests(facts)}
    assert set(shown) == {*(f"confirmation_{metric}" for metric in ("mae", "rmse", "p95", "p99")), "screening"}
    decision = next(held for held in thesis["decisions"] if held["phase"] == "confirmation")
    first = decision["facts"]["evidence"][0]
    effect = next(e for e in shown["confirmation_mae"].effects if e.module == facts.module(first["module"]))
    assert (effect.value, effect.p, effect.adjusted) == (first["d_z"], first["printed_p"], first["adjusted"])
    assert effect.low is None or effect.low <= effect.value <= effect.high
    assert all(view.low is None and view.p is None for view in shown["screening"].effects)
    spec = figures_of(page_of(thesis))["confirmation"]
    assert {trace["meta"]["phase"] for trace in spec["figure"]["data"]} == set(shown) - {"screening"}
    assert any("follows the thesis's tests" in line for line in caveats(facts))
    tests = study_tables(facts)["tests"]
    assert len(tests.rows) == len(decision["facts"]["evidence"])


@pytest.mark.parametrize("last", PHASES)
@pytest.mark.parametrize("mode", ["sound", "thesis"])
def test_a_study_that_is_only_partly_done(request, unfinished, mode, last):
    study = unfinished(request.getfixturevalue(mode), last)
    facts = parse_study(study)
    text = page_of(study)
    place = PHASES.index(last)
    for name, lines in zip(PHASES, decided(facts), strict=True):
        known = name in facts.decided
        assert known == (PHASES.index(name) < place)
        assert known or lines[1][0].startswith(("Under way: ", "Has not begun."))
    assert ("variance" in plots_of(facts)) == (place > 0)
    assert ("confirmation" in plots_of(facts)) == (place > 4)
    assert f"{place} of 8 phases are decided" in headline(facts) or place > 5
    assert f"The search is running in phase {NUMBERS[last]}" in " ".join(verdict(facts))
    ended = sum(held["status"] != "waiting" for held in study["history"])
    assert ended == len(facts.ended) < len(study["history"]) or last == "planning"
    assert "not decided yet" in missing(facts, last)
    assert "not decided yet" in text.split("<script>")[0] or last == "planning"
    assert study_text(facts, study_tables(facts)).startswith("# Model search on m22.toml")


def test_an_empty_study_is_a_report_too(unfinished, sound, tmp_path):
    study = unfinished(sound, "isolation")
    study |= {"history": [], "phases": []}
    made = write_study_page(parse_study(study), tmp_path)
    assert made.pictures == ()
    assert "No training has a score yet." in made.page.read_text(encoding="utf-8")
    assert "was killed: 0 of 8" in headline(parse_study(study | {"state": "killed"}))


def test_the_headline_says_what_the_test_sessions_say(sound):
    facts = next(held["facts"] for held in sound["decisions"] if held["phase"] == "synthesis")
    assert "below the baseline's" in headline(parse_study(sound))
    facts["test_gain"] = {"change": -0.05, "low": -0.08, "high": -0.02, "p": 0.001}
    assert "chance" not in verdict(parse_study(sound))[0]
    facts["test_gain"] = {"change": -0.05, "low": -0.12, "high": 0.02, "p": 0.08}
    assert "so chance alone may have done it" in verdict(parse_study(sound))[0]
    facts["test"]["synthesis"]["composite"] = 99.0
    assert headline(parse_study(sound)).startswith("Nothing better than the baseline was found")
    facts["test"]["synthesis"] = dict.fromkeys(facts["test"]["synthesis"])
    facts["test_gain"] = None
    assert "failed" in headline(parse_study(sound))
    page_of(sound)


def test_words_follow_the_settings(sound):
    text = " ".join(caveats(parse_study(sound)))
    assert "400 updates" in text
    assert "2,000 updates" in text
    assert "9 that train and judge in turn, 2 set apart, 1 more for phase 6" in text
    assert "6 more questions in phase 4, 12 in phase 5" in text
    sound["spec"]["final_updates"] = 400
    assert "no longer (400 updates)" in " ".join(caveats(parse_study(sound)))
    sentences = dict(decided(parse_study(sound)))["Phase 3: confirmation"]
    assert len(sentences) < len(MODULES)
    assert any(line.count(", ") > 5 and "stopped by the screening" in line for line in sentences)


def test_the_front_is_what_nothing_betters(sound):
    points = point_views(parse_study(sound))
    best = front(points, "parameters")
    for point in points:
        beaten = any(
            o.costs["parameters"] <= point.costs["parameters"] and o.score <= point.score and o is not point
            for o in points
        )
        assert (point in best) != beaten or point in best
    assert [p.score for p in best] == sorted((p.score for p in best), reverse=True)
    tie = [PointView("a", 1.0, {"parameters": 5.0}, "", ""), PointView("a", 1.0, {"parameters": 9.0}, "", "")]
    assert front(tie, "parameters") == (tie[0],)
    assert {p.picked for p in points if p.picked} == {
        *("baseline", "taken of LSTM", "winner of phase 4", "winner of phase 5")
    }


def test_the_history_keeps_failures_apart(sound):
    sound["history"][5]["score"] = 400.0
    views = tracks(parse_study(sound))
    assert sum(len(view.places) for view in views) == len(sound["history"])
    top = top_of(score for view in views for score in view.scores)
    assert top < 20
    named = {trace.name: trace for trace in plots_of(parse_study(sound))["history"].figure.data}
    assert len(named["failed"].x) == sum(held["score"] is None for held in sound["history"])
    assert len(named["above the scale"].x) == 1
    assert [len(view.places) for view in views if view.heading == "Phase 4, test sessions"] == [4]
    assert top_of([]) is None
    assert top_of([2.0]) > 2.0
    assert len(arm_views(parse_study(sound))) == 4


def test_what_was_pruned_is_no_failure(sound, tmp_path):
    failed = sum(held["score"] is None for held in sound["history"])
    place = next(
        place for place, held in enumerate(sound["history"]) if held["phase"] == "calibration" and held["score"]
    )
    sound["history"][place] |= {"status": "pruned", "score": None, "rung": 50}
    sound["phases"][1]["pruned"] = 1
    facts = parse_study(sound)
    named = {trace.name: trace for trace in plots_of(facts)["history"].figure.data}
    assert named["pruned"].x == (place + 1,)
    assert len(named["failed"].x) == failed
    assert tiles(facts)[0][2] == f"trainings, 1 of them pruned, {failed} of them failed"
    sheet = study_tables(facts)["phases"]
    assert [column.heading for column in sheet.columns].index("Pruned") == 3
    assert [row[3] for row in sheet.rows] == [0, 1, 0, 0, 0, 0, 0, 0, 1]
    assert write_study_page(parse_study(sound), tmp_path).pictures


def test_names_that_mean_something_elsewhere(sound, tmp_path):
    odd = "<script>|$x_1$"
    sound["modules"]["squeeze_excitation"] = odd
    sound["data"]["path"] = f"/{odd}"
    sound["history"][0]["label"] = odd
    made = write_study_page(parse_study(sound), tmp_path, pictures=False)
    assert "<script>|" not in made.page.read_text(encoding="utf-8")
    assert "\\|$x\\_1$" in made.text.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "no 'schema'; give the study.json"),
        ('{"a": 1}', "no 'schema'; give the study.json"),
        ('{"schema": 1}', "has schema 1, this version of EDP reads 2"),
        ('{"schema": 2, "state": "done", "mode": "sound"}', "state = 'done'; running, stopped, killed, finished"),
        ('{"schema": 2, "state": "running"', "is not valid JSON"),
        ("\ufeff", "is not valid JSON"),
    ],
)
def test_what_is_no_study_is_refused(tmp_path, content, message):
    (tmp_path / "study.json").write_text(content, encoding="utf-8")
    with pytest.raises(StorageError, match=message):
        read_study(tmp_path)
    with pytest.raises(StorageError, match=r"nothing.*cannot be read"):
        read_study(tmp_path / "nothing.json")


def test_a_study_is_read_as_it_was_written(tmp_path, sound):
    (tmp_path / "study.json").write_text(json.dumps(sound), encoding="utf-8")
    assert read_study(tmp_path) == read_study(tmp_path / "study.json") == parse_study(sound)


def test_a_missing_part_is_named(sound):
    del sound["history"]
    with pytest.raises(StorageError, match="'history' is missing"):
        page_of(sound)


def test_missing_facts_name_their_phase(sound):
    del sound["decisions"][2]["facts"]["modules"]["zoneout"]["change"]
    with pytest.raises(StorageError, match=r"phase 'screening': 1 problem\n  - 'modules.zoneout.change' is missing"):
        page_of(sound)


@pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mode", ["sound", "thesis"])
def test_whatever_is_broken_gives_a_report_or_one_clear_error(request, mode, count, tmp_path, monkeypatch):
    whole = request.getfixturevalue(mode)
    rng = random.Random(7)
    messages = []
    for _ in range(count):
        study = copy.deepcopy(whole)
        damage(study, rng)
        try:
            write_study_page(parse_study(study), tmp_path, pictures=False)
        except EdpError as error:
            messages.append(str(error))
    assert 1 < len(messages) < count
    assert all("study" in message for message in messages)


def damage(value, rng):
    """Change one thing somewhere deep down."""
    while True:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = rng.choice(keys)
        held = value[key]
        if isinstance(held, dict | list) and held and rng.random() < 0.85:
            value = held
            continue
        if isinstance(value, dict) and rng.random() < 0.4:
            del value[key]
        else:
            value[key] = rng.choice([None, "odd", -1, [], {}, 1e300, True])
        return


@pytest.mark.parametrize("mode", ["sound", "thesis"])
def test_the_text_of_the_page(request, mode):
    check_text(page_of(request.getfixturevalue(mode)), f"study_{mode}")


def test_the_text_of_the_page_of_an_unfinished_study(sound, unfinished):
    check_text(page_of(unfinished(sound, "screening")), "study_unfinished")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, sound, tmp_path):
    check_page(browser, write_study_page(parse_study(sound), tmp_path, pictures=False).page, "model search")
