"""Units of reports: values have the offset of their unit, differences have none, and every use chooses one of both."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import edp
from edp.evaluation.scores_file import ScoredTarget
from edp.live.layout import Forecast, LiveLayout, LiveTrace
from edp.logs.quality.quality import inspect
from edp.recording import Recording
from edp.report.notebook.figures import BandLine, prediction_figure, recordings_figure
from edp.signals import KINDS, UNITS, Channel, Kind, display_offset

SOURCE = Path(edp.__file__).parent
DIFFERENCES = {
    "evaluation/step_response.py": "changes after a step of a command",
    "evaluation/ruler.py": "errors, and values that only differences are taken of",
    "evaluation/free_run_parts.py": "errors",
    "monitor/detectable.py": "shifts of a channel",
    "evaluation/context.py": "errors",
    "evaluation/channel_importance.py": "errors",
    "training/bagging/perceptrons.py": "errors",
    "training/validation.py": "errors",
    "workflows/twin/judge_twin.py": "kept in a file; readers add `display_offset` to values",
    "training/compression/imitation.py": "errors",
    "workflows/auto/promise.py": "errors",
    "workflows/adaptation/replay.py": "errors",
    "workflows/fleet/judge_fleet.py": "errors",
    "workflows/transfer/scores.py": "errors",
    "workflows/transfer/finetune.py": "kept in a file; readers add `display_offset` to values",
    "workflows/live/free_run.py": "a forecast, which has the offset of its unit",
    "workflows/live/look_ahead.py": "a forecast, which has the offset of its unit",
    "logs/quality/quality.py": "standard deviation, noise, quantisation step",
    "logs/quality/checks.py": "size of a step",
    "data/coverage.py": "with the offset, or the difference of two channels",
    "live/layout.py": "with the offset beside it",
    "signals.py": "the definition",
}
"""Files that use the factor of a unit alone, and for what. A new one belongs here, or calls `KindFacts.to_report`."""


@pytest.mark.long
def test_the_factor_alone_is_used_for_differences_only():
    used = set()
    for path in SOURCE.rglob("*.py"):
        names = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        if "report_factor" in names:
            used.add(path.relative_to(SOURCE).as_posix())
    assert used == set(DIFFERENCES)


def test_no_text_shows_kelvin():
    shown = re.compile(r"\} (?:K|kelvin)\b")
    files = (path for suffix in ("py", "jinja", "js") for path in SOURCE.rglob(f"*.{suffix}"))
    assert [path.name for path in files if shown.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize("kind", list(Kind))
def test_the_unit_of_reports_is_a_unit_of_logs_and_agrees_with_it(kind):
    facts = KINDS[kind]
    unit = UNITS[facts.report_unit]
    assert kind in unit.kinds
    assert facts.report_factor * unit.factor == pytest.approx(1.0, rel=1e-12)
    assert facts.report_offset == pytest.approx(-unit.offset / unit.factor)


@pytest.mark.parametrize("kind", list(Kind))
@given(value=st.floats(-1e6, 1e6), size=st.floats(-1e3, 1e3))
def test_the_way_to_the_unit_of_reports_has_its_way_back(kind, value, size):
    facts = KINDS[kind]
    assert facts.from_report(facts.to_report(value)) == pytest.approx(value, rel=1e-9, abs=1e-9)
    # A difference of two values is the difference of what is shown of them.
    shown = facts.to_report(value + size) - facts.to_report(value)
    assert shown == pytest.approx(facts.report_factor * size, rel=1e-6, abs=1e-3)


def test_temperatures_are_shown_in_degrees_celsius():
    assert KINDS[Kind.TEMPERATURE].to_report(312.15) == pytest.approx(39.0)
    assert display_offset("degC") == -273.15
    assert display_offset("bar") == display_offset("no unit") == 0.0
    assert ScoredTarget(name="T", unit="degC").offset == -273.15


OIL = Channel("Oil", Kind.TEMPERATURE, "oil")


def oil() -> Recording:
    values = 312.15 + 5.0 * np.sin(np.arange(2000) / 100.0)
    return Recording("oil", (OIL,), values[:, None].astype(np.float32), 100.0)


def test_the_live_view_shows_degrees_celsius_in_what_is_measured_and_predicted():
    trace, forecast = LiveTrace.from_channel(OIL), Forecast("Oil", "degC", 1.0, 5, 1, measured=0)
    assert (trace.unit, trace.offset, forecast.offset) == ("degC", -273.15, -273.15)
    plain = LiveLayout("t", "s", 100.0, 2, [trace], [forecast]).to_dict()
    assert plain["forecasts"][0]["offset"] == plain["traces"][0]["offset"] == -273.15


def test_notebooks_show_degrees_celsius():
    recording = oil()
    for figure in (
        recordings_figure(recording, ["Oil"]),
        prediction_figure([BandLine(OIL, recording.column("Oil"), recording.column("Oil"))], 100.0, "t"),
    ):
        assert all(30.0 < np.mean(trace.y) < 50.0 for trace in figure.data)
        assert "degC" in figure.layout.annotations[0].text


def test_quality_states_values_with_the_offset_and_deviations_without():
    row = inspect(oil()).channels[0]
    assert row.mean == pytest.approx(39.0, abs=1.0)
    assert row.std == pytest.approx(3.5, abs=0.5)
