"""Fit, correlogram and interval bands of a report."""

import json
import math

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from edp.errors import DataError
from edp.report.common.interactive import plots
from edp.report.run.charts import run_charts, signal_chart
from edp.report.run.facts import read_facts
from edp.report.run.figures import prediction_lines, residual_histograms
from edp.report.run.page import build_run_page
from edp.report.run.residuals import correlations, correlogram, fit_table
from edp.storage import write_json


def test_fit_is_that_of_system_identification(run_folder):
    facts = read_facts(run_folder)
    table = fit_table(facts)
    assert [column.heading for column in table.columns] == ["Output", "10 ms ahead", "50 ms ahead", "100 ms ahead"]
    r2 = facts.models["network"].overall["5"]["CylVels_2"]["r2"]
    assert float(table.rows[1][2]) == pytest.approx(100 * (1 - math.sqrt(1 - r2)), abs=0.06)


def test_scores_without_r2_have_no_fit(run_folder):
    scores = json.loads((run_folder / "scores.json").read_text())
    for by_output in scores["models"]["network"]["overall"].values():
        for values in by_output.values():
            values["r2"] = None
    write_json(run_folder / "scores.json", scores)
    assert fit_table(read_facts(run_folder)) is None


def rewritten(folder, change):
    arrays = load_file(folder / "predictions.safetensors")
    change(arrays)
    save_file(arrays, folder / "predictions.safetensors")
    return read_facts(folder)


def with_residuals(folder, make):
    """The run with these residuals at 1 tick ahead: (time,) for each of its recordings."""

    def change(arrays):
        for key in [key for key in arrays if key.endswith("/network")]:
            truth = arrays[key.replace("network", "truth")]
            predicted = arrays[key].copy()
            error = make(len(truth))
            predicted[:-1, 0] = truth[1:] + error[1:, None]
            arrays[key] = predicted

    return rewritten(folder, change)


def test_white_residuals_stay_inside_and_coloured_ones_do_not(run_folder):
    random = np.random.default_rng(5)
    facts = with_residuals(run_folder, lambda n: random.normal(size=n).astype(np.float32))
    values, count = correlations(facts, 1, 0)
    assert count > 2000
    assert np.mean(np.abs(values) > 2.576 / math.sqrt(count)) < 0.15

    def coloured(n):
        noise, out = random.normal(size=n), np.zeros(n)
        for t in range(1, n):
            out[t] = 0.8 * out[t - 1] + noise[t]
        return out.astype(np.float32)

    values, _ = correlations(with_residuals(run_folder, coloured), 1, 0)
    assert values[:3] == pytest.approx([0.8, 0.64, 0.512], abs=0.08)


def test_gaps_and_constant_residuals_draw_nothing(run_folder):
    facts = with_residuals(run_folder, lambda n: np.zeros(n, np.float32))
    assert len(correlations(facts, 1, 0)[0]) == 0 or np.isfinite(correlations(facts, 1, 0)[0]).all()

    def gap(arrays):
        for key in [key for key in arrays if key.endswith("/network")]:
            arrays[key] = np.full_like(arrays[key], np.nan)

    assert correlogram(rewritten(run_folder, gap)) is None


def test_the_interval_is_drawn_around_the_prediction(run_folder):
    def widen(arrays):
        for key in [key for key in arrays if key.endswith("/network")]:
            arrays[f"{key}_low"], arrays[f"{key}_high"] = arrays[key] - 0.01, arrays[key] + 0.01

    facts = rewritten(run_folder, widen)
    lines = [line for line in prediction_lines(facts) if line.low is not None]
    assert {line.model for line in lines} == {"network"}
    for line in lines:
        np.testing.assert_allclose(line.high - line.low, np.where(np.isfinite(line.y), 20.0, np.nan), rtol=1e-3)
    drawn = plots(run_charts(facts))["predictions"].figure.data
    bands = [trace for trace in drawn if trace.fill == "tonexty"]
    assert len(bands) == len(lines)
    assert {trace.name for trace in bands} == {"Interval"}
    # The ends of the interval are no models of their own.
    assert {item.model for item in residual_histograms(facts)} == {"network", "ridge_arx"}


def test_many_traces_are_drawn_of_fewer_recordings(run_folder):
    facts = read_facts(run_folder)
    assert len({line.recording for line in prediction_lines(facts)}) == 3
    few = prediction_lines(facts, budget=15_000)
    assert len({line.recording for line in few}) == 1
    assert sum(len(line.y) for line in few) <= 15_000


def with_signals(folder, columns):
    scores = json.loads((folder / "scores.json").read_text())
    scores["inputs"] = [
        {"name": "</script><b>lever", "unit": "1", "factor": 1.0},
        {"name": "p_head", "unit": "bar", "factor": 1e-5},
    ]
    write_json(folder / "scores.json", scores)

    def keep(arrays):
        ticks = len(arrays["trench_01/truth"])
        arrays["trench_01/inputs"] = np.linspace(0, 2e7, ticks * columns, dtype=np.float32).reshape(ticks, columns)

    return rewritten(folder, keep)


def test_raw_signals_stand_first_in_their_units(run_folder):
    facts = with_signals(run_folder, 2)
    chart = signal_chart(facts)
    assert [panel.title for panel in chart.panels] == ["</script><b>lever", "[bar]"]
    assert chart.panels[1].marks[0].y.max() == pytest.approx(200, rel=1e-3)
    page = build_run_page(facts).html()
    assert page.index("Raw signals</h2>") < page.index("Against the baselines</h2>")
    assert "<b>lever" not in page
    assert {item.model for item in residual_histograms(facts)} == {"network", "ridge_arx"}


def test_signals_of_another_shape_are_refused(run_folder):
    with pytest.raises(DataError, match="inputs"):
        with_signals(run_folder, 3)
