"""The page of closed loops: what it says, that names stay text, and that figures hold what was run."""

import numpy as np
import pytest
from browser import check_page
from page_text import check_text

from edp.control.run_file import ControlFile
from edp.recording import Recording
from edp.report.animation.page import scene_of
from edp.report.control.charts import control_charts, errors_chart, path_chart
from edp.report.control.facts import ControlFacts, event_table, loop_table, tiles, verdict
from edp.report.control.page import build_control_page
from edp.signals import VOCABULARY, Channel, Kind

TICKS = 120
STROKES = ("CylStroke_1", "CylStroke_2", "CylStroke_3")
TIP = ("TipX", "TipY", "TipAngle")
HOSTILE = "<script>alert(1)</script>"


def recording(name, offset):
    """The tip stands `offset` metres above its reference."""
    measured = [VOCABULARY[n] for n in (*STROKES, "CylVels_1", "CylVels_2", "CylVels_3")]
    true = [Channel(f"{n}_true", VOCABULARY[n].kind) for n in (*STROKES, *TIP)]
    reference = [Channel(f"Reference_{n}", VOCABULARY[n].kind) for n in (*STROKES, *TIP)]
    levers = [Channel(f"Lever_{i}", Kind.RATIO) for i in (1, 2, 3)]
    channels = (*measured, *true, *reference, *levers)
    values = np.full((TICKS, len(channels)), 0.6, np.float32)
    names = [channel.name for channel in channels]
    values[:, names.index("TipX_true")] = values[:, names.index("Reference_TipX")] = np.linspace(4.0, 5.0, TICKS)
    values[:, names.index("TipY_true")] = 0.6 + offset
    return Recording(name, channels, values, 100.0)


@pytest.fixture(scope="module")
def facts():
    recordings = [recording("grade_0", 0.010), recording(HOSTILE, 0.003)]
    score = {
        "position_rms_mm": 10.0, "position_p95_mm": 10.0, "position_max_mm": 10.0, "path_rms_mm": 10.0,
        "path_p95_mm": 10.0, "path_max_mm": 10.0, "attitude_rms_deg": 0.1, "arrived_s": None, "energy_kj": 12.0,
        "lever_travel": 3.0, "violations": {"lever": 0, "slew": 0, "stroke": 4, "pressure": 0}, "missed": 0,
        "finished": True,
    }  # fmt: skip
    loops = [
        {
            "name": r.name, "seed": n, "seconds": 1.2, "score": score, "events": [], "warnings": [],
            "solve_us": {"median": 50.0, "p99": 60.0, "max": 70.0},
        }
        for n, r in enumerate(recordings)
    ]  # fmt: skip
    loops[1]["events"] = [{"tick": 7, "ticks": 3, "text": f"{HOSTILE} is missing"}]
    content = {
        "schema": 1, "edp": "0", "sentence": f"pi keeps {HOSTILE}", "task": {"kind": "grade"},
        "controller": {"kind": "pi"}, "machine": "M22", "plant": "the simulator", "loops": loops,
        "summary": {
            "position_rms_mm": 10.0, "position_worst_mm": 10.0, "path_rms_mm": 10.0, "path_worst_mm": 10.0,
            "attitude_rms_deg": 0.1, "lever_travel": 3.0, "energy_kj": None, "violations": 8, "missed": 3,
            "solve_us_median": 50.0,
        },
    }  # fmt: skip
    times = [np.linspace(40.0, 70.0, TICKS)] * 2
    return ControlFacts(
        "run", ControlFile.from_table(content, "the file"), recordings, times, scene_of(recordings[0], "M22")
    )


def test_the_page_says_what_was_violated_and_missed(facts):
    text = " ".join(verdict(facts))
    assert "Limits were violated at 8 ticks" in text
    assert "no answer at 3 ticks" in text
    assert loop_table(facts).rows[0][-1] == "stroke 4"
    assert event_table(facts).rows == ((HOSTILE, 7, 3, f"{HOSTILE} is missing"),)


def test_the_position_error_stands_before_the_distance_to_the_path(facts):
    words = [what for _, _, what in tiles(facts)]
    assert words[0].startswith("position error")
    assert any(what.startswith("distance to the path") for what in words)
    # A twin tells no energy: there is no tile of it.
    assert not any("energy" in what for what in words)


def test_figures_hold_the_loops(facts):
    assert [chart.name for chart in control_charts(facts)] == ["path", "errors", "strokes", "levers", "solver"]
    (choice,) = path_chart(facts, control_charts(facts)[0].choices[0]).choices
    assert [text for _, text in choice.options] == ["grade_0", HOSTILE]
    position = errors_chart(facts, choice).panels[0].marks
    assert position[0].y == pytest.approx([10.0] * TICKS, abs=1e-3)
    assert position[1].y == pytest.approx([3.0] * TICKS, abs=1e-3)


def test_names_stay_text(facts):
    page = build_control_page(facts).html()
    assert HOSTILE not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert 'id="front"' in page
    assert "http://" not in page.split("<script>")[0]


def test_the_text_of_the_page(facts):
    check_text(build_control_page(facts).html(), "control")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, facts, tmp_path):
    page = tmp_path / "control.html"
    build_control_page(facts).write(page)
    check_page(browser, page, "closed loops")
