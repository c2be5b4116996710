"""The page of a twin: what it shows, kinds of channels apart, and names that are only names."""

import json
from dataclasses import replace

import numpy as np
import pytest
from browser import check_page
from page_text import check_text
from safetensors.numpy import save

from edp.data.twin_channels import TwinChannels
from edp.errors import StorageError
from edp.evaluation.free_run import FreeRunJudgeSpec, FreeRuns, free_run_scores
from edp.evaluation.free_run_file import FreeRunFile
from edp.networks.twin import calibrate
from edp.report.common.interactive import plots
from edp.report.twin.charts import twin_charts
from edp.report.twin.facts import FreeRunFacts, free_run_tables, headline, read_free_runs, tiles, verdict
from edp.report.twin.page import build_twin_page
from edp.settings.provenance import Provenance
from edp.signals import Channel, Kind
from edp.storage import read_json, write_json
from edp.workflows.twin.judge_twin import describe_channels, select_shown_runs, write_scores

HOSTILE = "</script><img src=x onerror=alert(1)>"
SPEC = FreeRunJudgeSpec(at_s=(0.2, 1.0), coverage_at_s=(0.2, 1.0))


def judged(strokes=True, name="boom", swing=False, kind=Kind.VELOCITY):
    """Scores and runs of a twin of one cylinder with noise for errors, in two recordings; with a swing of two axes."""
    stroke = (Channel(f"{name} stroke", Kind.POSITION),) if strokes else ()
    velocity, pressure = (Channel(name, kind),), (Channel("p", Kind.PRESSURE),)
    if swing:
        velocity, stroke = (*velocity, Channel("swing", Kind.ANGULAR_VELOCITY)), (*stroke, Channel("pose", Kind.ANGLE))
        pressure = ()
    channels = TwinChannels((Channel("u", Kind.RATIO),), velocity, stroke, pressure, 10.0)
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(4, 30, len(channels.answers))).astype(np.float32)
    answers = truth + rng.normal(0, 1e-3, truth.shape).astype(np.float32)
    size = 3 * np.ones(len(channels.answers), np.float32)
    runs = FreeRuns(channels, ("a", "a", name, name), answers, truth, truth[:, 0], -size, size)
    intervals = calibrate(answers - truth, 0.9)
    scores = free_run_scores(runs, SPEC, intervals, {"a": "dig", name: "grade"})
    return {"twin": scores, "static": free_run_scores(runs, SPEC)}, runs, intervals


def facts_of(**options):
    scores, runs, intervals = judged(**options)
    content = FreeRunFile(channels=describe_channels(runs.channels), models=scores)
    return FreeRunFacts("m22", content, select_shown_runs(runs, intervals))


def grounded(ground, data=None):
    more = {"ground": ground} | ({"ground_data": data} if data else {})
    return replace(facts_of(), provenance=Provenance(more=more))


@pytest.mark.parametrize(
    ("ground", "says"),
    [
        ({"kind": "drag", "explained": {"train": 0.62, "validation": 0.5}}, "'drag': explains 62 % (train) and 50 %"),
        ({"kind": ["x"], "explained": {"train": float("nan"), "validation": "all"}}, "ground: explains nothing of"),
    ],
)
def test_a_ground_is_told_with_what_it_explains(ground, says):
    lines = verdict(
        replace(facts_of(), provenance=Provenance(more={"ground": ground, "ground_data": {"source": "loam"}}))
    )
    (line,) = (one for one in lines if "ground" in one)
    assert says in line.replace("\xa0", " ")
    assert line.endswith("free runs and errors of this page are in free air.")


def test_a_ground_of_a_stranger_is_text():
    text = build_twin_page(
        replace(
            facts_of(), provenance=Provenance(more={"ground": {"kind": HOSTILE}, "ground_data": {"source": HOSTILE}})
        )
    ).html()
    assert "<img src=x" not in text
    assert not any("ground" in line for line in verdict(grounded([HOSTILE])))


def plots_of(facts):
    return plots(twin_charts(facts))


def test_each_kind_of_channel_has_its_own_unit_and_figure():
    facts = facts_of()
    drawn = plots_of(facts)
    assert set(drawn) == {"runs_velocities", "runs_strokes", "runs_pressures", "horizon"}
    titles = [note.text for note in drawn["horizon"].figure.layout.annotations]
    assert titles == ["Velocities [mm/s]", "Strokes [mm]", "Pressures [bar]"]
    assert "mm after 1 s" in headline(facts).replace("\xa0", " ")
    assert [unit for _, unit, what in tiles(facts) if "error" in what] == ["mm/s", "mm", "mm", ""]


def test_actuators_of_different_units_stand_alone():
    facts = facts_of(swing=True)
    key_figures = [(unit, what) for _, unit, what in tiles(facts)]
    assert key_figures[:2] == [("mm", "error of boom stroke after 1 s"), ("deg", "error of pose after 1 s")]
    assert not any("pressures" in what for _, what in key_figures)
    sheet = free_run_tables(facts)["actuators"]
    assert [row[:2] for row in sheet.rows] == [(a, m) for a in ("boom", "swing") for m in ("twin", "static")]
    assert sheet.rows[0][2].endswith(" mm/s")
    assert sheet.rows[3][3].endswith(" deg")
    page = build_twin_page(facts).html()
    assert "each actuator in its units" in page
    assert "The twin and its floors</caption>" not in page
    headings = [column.heading for column in free_run_tables(facts)["recordings"].columns]
    assert headings == ["Recording", "Runs", "Diverged"]


def test_a_run_is_drawn_with_its_interval():
    facts = facts_of()
    figure = plots_of(facts)["runs_velocities"].figure
    low, high, truth, answers = figure.data[:4]
    assert high.fill == "tonexty"
    assert len(truth.y) == 30
    np.testing.assert_allclose((np.array(high.y) + low.y) / 2, answers.y, rtol=1e-2, atol=2.0)
    assert [trace.visible for trace in figure.data[::4]] == [True, False]
    assert (np.array(high.y) > low.y).all()


def test_tables_say_what_the_scores_hold():
    facts = facts_of()
    sheets = free_run_tables(facts)
    assert list(sheets) == ["models", "recordings", "driving", "situations", "intervals"]
    assert [row[0] for row in sheets["driving"].rows] == ["dig", "grade"]
    assert sheets["models"].rows[0][2] == facts.twin.velocity_mae.mean
    assert sheets["intervals"].rows[1][2] == facts.twin.intervals.at[1].velocities.half_width.mean
    worst = [max(row[3:5]) for row in sheets["recordings"].rows]
    assert len(worst) == 2


def test_a_twin_without_strokes_has_a_page_too():
    facts = facts_of(strokes=False)
    assert "runs_strokes" not in plots_of(facts)
    assert "Strokes off by" in build_twin_page(facts).html()


def test_plain_numbers_have_no_strokes_in_the_headline():
    facts = facts_of(strokes=False, name="level", kind=Kind.GENERIC)
    assert " level off by " in headline(facts)
    assert "Strokes off by" not in build_twin_page(facts).html()


def test_names_are_text_on_the_page():
    page = build_twin_page(facts_of(name=HOSTILE), title=HOSTILE).html()
    assert "onerror=alert(1)>" not in page.replace("&gt;", "")
    assert "<img src=x" not in page


@pytest.fixture
def folder(tmp_path):
    scores, runs, intervals = judged()
    write_scores(tmp_path, scores, runs, intervals)
    return tmp_path


def test_what_was_written_is_read(folder):
    facts = read_free_runs(folder)
    assert facts.names == ["a", "boom"]
    assert build_twin_page(replace(facts, title="m22")).html().count('class="figure"') == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(schema=1), "of another version of EDP"),
        (lambda content: content["models"].pop("twin"), "'models.twin' is missing"),
        (lambda content: content["models"]["twin"]["velocity_mae"].update(mean="low"), "models.twin.velocity_mae.mean"),
        (
            lambda content: content["models"]["twin"]["stroke_error"][0].pop("unit"),
            r"stroke_error\[0\]\.unit'",
        ),
        (lambda content: content["channels"]["pressures"].append({"name": 3}), "channels.pressures"),
        (lambda content: content["channels"]["pressures"].clear(), "does not fit its scores"),
    ],
)
def test_damaged_scores_are_refused_with_what_is_wrong(folder, change, message):
    content = json.loads((folder / "free_run.json").read_text())
    change(content)
    write_json(folder / "free_run.json", content)
    with pytest.raises(StorageError, match=message):
        read_free_runs(folder)


def test_damaged_runs_are_refused(folder):
    (folder / "free_runs.safetensors").write_bytes(b"x")
    with pytest.raises(StorageError, match="was changed since it was written with the result"):
        read_free_runs(folder)
    # As earlier versions wrote them: without the hash of the runs.
    content = {name: part for name, part in read_json(folder / "free_run.json").items() if name != "files"}
    write_json(folder / "free_run.json", content)
    with pytest.raises(StorageError, match="cannot read"):
        read_free_runs(folder)
    (folder / "free_runs.safetensors").write_bytes(save({"seconds": np.zeros(1, np.float32)}))
    with pytest.raises(StorageError, match="does not fit its scores: 'seconds'"):
        read_free_runs(folder)


def test_the_text_of_the_page():
    check_text(build_twin_page(facts_of(), "m22").html(), "twin")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, tmp_path):
    page = tmp_path / "twin.html"
    build_twin_page(facts_of()).write(page)
    check_page(browser, page, "free runs", ("boom", "dig"))
