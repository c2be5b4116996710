"""The page of a monitor's run: the answer first, names stay text, no script, no request, small."""

import re

import numpy as np
import pytest
from browser import check_page
from page_text import check_text

from edp.monitor.diagnosis.causes import Cause
from edp.monitor.diagnosis.structure import Confusion
from edp.monitor.traces import RecordingTrace, RunTraces
from edp.report.monitor.drawing import POINTS, evidence, overview, timeline
from edp.report.monitor.facts import AlarmFacts, MonitorFacts, confusions_of, headline, verdict
from edp.report.monitor.page import build_monitor_page

HOSTILE = "</title><script>alert(1)</script><img src=x onerror=alert(1)>"
GROUPS = ("velocities", "head pressures", HOSTILE)


def trace(name, blocks=480, start="", silent=()):
    rng = np.random.default_rng(len(name))
    ratios = np.abs(rng.normal(0.4, 0.1, (blocks, 2))).astype(np.float32)
    groups = np.abs(rng.normal(1.0, 0.3, (blocks, 3))).astype(np.float32)
    ratios[blocks // 2 :] += 0.9
    groups[blocks // 2 :, 1] += 4.0
    groups[:, 2] = np.nan
    return RecordingTrace(name, start, float(blocks), ratios, groups, silent)


def alarm(recording, **changes):
    cause = Cause(
        "pressure_bias", "boom_head", "sensor of boom head pressure", "sensor", 9.8, "bar", 0.93,
        "head pressure of the boom reads 9.8 bar too high", 0.7,
    )  # fmt: skip
    other = Cause(
        "external_leak", "boom_head", "boom cylinder", "machine", 1.0, "L/min", 0.04, "the boom head leaks", 0.3, True
    )
    values = {
        "recording": recording, "raised_s": 262.0, "since_s": 241.0, "detector": "cusum", "statistic": 14.0,
        "limit": 10.0, "evidence": (("virtual:BoomHeadPressure.mean", 4.2), (HOSTILE, -1.1)),
        "causes": (cause, other), "severity": "warning",
        "sentence": "head pressure of the boom reads 9.8 bar too high since 14:02:11; 0.93",
    }  # fmt: skip
    return AlarmFacts(**{**values, **changes})


@pytest.fixture
def facts():
    traces = RunTraces(1.0, ("cusum", "ewma"), GROUPS, (trace("monday", start="2026-11-23T13:58:10"), trace(HOSTILE)))
    confusions = (Confusion("pressure_bias:boom_head", "pressure_scale:boom_head", 0.31, "PumpPressure_1", 0.05),)
    alarms = [alarm("monday"), alarm(HOSTILE, sentence=f"{HOSTILE} since 0:04:01", severity="stop")]
    return MonitorFacts("week 48", traces, alarms, "2 false alarms in 16 h", confusions, 147, [("Logs", HOSTILE)])


def test_the_headline_answers_first(facts):
    assert headline(facts) == "2 alarms in 16 min: head pressure of the boom reads 9.8 bar too high (2 times)"
    facts.alarms[:] = []
    assert headline(facts) == "No alarm in 16 min"
    assert "No alarm" in build_monitor_page(facts).html()


def test_what_is_not_named_is_said(facts):
    facts.alarms[:] = [alarm("monday", causes=(), sentence="something")]
    assert "unnamed changes" in headline(facts)
    assert "no dictionary" in " ".join(verdict(MonitorFacts("x", facts.traces, facts.alarms, "")))


def test_pairs_that_are_not_told_apart_are_named_with_the_alarm(facts):
    (line,) = confusions_of(facts, facts.alarms[0])
    assert "pressure_scale:boom_head; PumpPressure_1 would separate them" in line


def test_names_of_files_stay_text(facts):
    page = build_monitor_page(facts).html()
    assert "<script" not in page
    assert "<img" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_the_page_asks_nothing_of_a_network_and_runs_nothing(facts, tmp_path):
    page = build_monitor_page(facts).write(tmp_path / "page.html").read_text()
    assert "default-src 'none'" in page
    assert not re.findall(r"(?:src|href)\s*=\s*\"(?!#)", page)
    assert "url(" not in page
    assert "@import" not in page


def test_a_week_of_logs_stays_below_three_megabytes():
    rng = np.random.default_rng(3)
    recordings = []
    for n in range(200):
        rough = np.abs(rng.normal(1.0, 1.5, (2880, 8))).astype(np.float32)
        recordings.append(RecordingTrace(f"shift_{n}", "", 2880.0, rough[:, :2], rough, ()))
    traces = RunTraces(1.0, ("cusum", "ewma"), tuple("abcdefgh"), tuple(recordings))
    alarms = [alarm(f"shift_{n}", sentence="x" * 200) for n in range(200)]
    assert len(build_monitor_page(MonitorFacts("week", traces, alarms, "")).html().encode()) < 3_000_000


def test_lines_and_cells_are_bounded_and_show_the_largest_values(facts):
    long = RunTraces(1.0, ("cusum", "ewma"), GROUPS, (trace("long", blocks=100_000),))
    drawing = timeline(long.recordings[0], MonitorFacts("x", long, [], ""))
    assert len(drawing.lines[1].points.split()) <= POINTS
    heights = [float(point.split(",")[1]) for point in drawing.lines[1].points.split()]
    # Before the change the line stays below the limit, then above it: smaller is higher up.
    limit = float(drawing.lines[0].points.split()[0].split(",")[1])
    assert min(heights[: len(heights) // 3]) > limit > max(heights[2 * len(heights) // 3 :])


def test_a_silent_group_is_said_to_be_silent(facts):
    patches = timeline(facts.traces.recordings[0], facts).patches
    assert any(patch.text == f"{HOSTILE}: silent" for patch in patches)
    assert any(patch.text == "head pressures: 5 times healthy and above" for patch in patches)


def test_evidence_goes_to_both_sides():
    drawing = evidence(alarm("monday"))
    axis, up, down = drawing.boxes
    assert up.x >= axis.x
    assert down.x + down.width <= axis.x + 1.0
    assert up.width > 3 * down.width


def test_times_of_day_are_shown_where_the_start_is_known(facts):
    monday = timeline(facts.traces.recordings[0], facts)
    assert any(label.text == "13:58:10" for label in monday.labels)
    assert any(label.text == "0:00:00" for label in overview(facts).labels)


def test_the_text_of_the_page(facts):
    check_text(build_monitor_page(facts).html(), "monitor")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, facts, tmp_path):
    page = tmp_path / "monitor.html"
    build_monitor_page(facts).write(page)
    check_page(browser, page, "monitor", ("the boom", "boom head", "boom cylinder"))
