import dataclasses

import numpy as np
import pytest

from edp.evaluation.scores_file import ModelScores
from edp.report.common.chart import BLUE, GREY
from edp.report.common.interactive import plots
from edp.report.run import figures
from edp.report.run.charts import learning_chart, run_charts
from edp.report.run.facts import NETWORK, TRUTH, HistoryRow, read_facts


def plots_of(facts):
    return plots(run_charts(facts))


@pytest.fixture
def facts(run_folder):
    return read_facts(run_folder)


def test_predictions_are_moved_to_the_time_they_speak_of():
    said = np.arange(5.0)[:, None]
    assert np.array_equal(figures.aligned(said, 2)[:, 0], [np.nan, np.nan, 0, 1, 2], equal_nan=True)
    assert np.isnan(figures.aligned(said, 9)).all()


def test_downsampling_keeps_peaks_and_both_ends():
    y = np.sin(np.linspace(0, 20, 20_000))
    y[7321] = 9.0
    kept = figures.downsample(y, 300)
    assert len(kept) <= 300
    assert {0, 7321, len(y) - 1} <= set(kept.tolist())


def test_downsampling_breaks_the_line_at_gaps():
    y = np.ones(1000)
    y[:10] = y[400:500] = np.nan
    kept = figures.downsample(y, 50)
    assert np.isnan(y[kept]).sum() == 1
    assert np.flatnonzero(np.isnan(y[kept])).item() == np.searchsorted(kept, 400)
    assert len(figures.downsample(np.full(10, np.nan), 5)) == 0


def test_the_busiest_stretch_is_where_the_outputs_move():
    truth = np.zeros((1000, 2))
    truth[600:700, 1] = np.sin(np.arange(100.0))
    start = figures.busiest_start(truth, 150)
    assert start <= 600
    assert start + 150 >= 700
    assert figures.busiest_start(truth, 5000) == 0


def test_a_perfect_prediction_lies_on_the_truth(facts):
    name, parts = next(iter(facts.predictions.items()))
    truth, perfect = parts[TRUTH], np.full_like(parts[NETWORK], np.nan)
    for column, k in enumerate(facts.horizons):
        perfect[:-k, column] = truth[k:]
    facts = dataclasses.replace(facts, predictions={name: {TRUTH: truth, NETWORK: perfect}})
    lines = [line for line in figures.prediction_lines(facts) if line.extent == figures.EXCERPT]
    truths = {line.target: line.y for line in lines if line.horizon is None}
    for line in lines:
        finite = np.isfinite(line.y)
        assert np.allclose(line.y[finite], truths[line.target][finite])
    assert all(item.deviation == 0 for item in figures.residual_histograms(facts))


def test_all_prediction_lines_together_keep_to_the_budget(make_run):
    facts = read_facts(make_run("long", samples=6000))
    lines = figures.prediction_lines(facts, budget=30_000)
    assert sum(len(line.y) for line in lines) <= 1.1 * 30_000


def test_residual_shares_and_what_lies_outside_add_up(facts):
    found = figures.residual_histograms(facts)
    assert {item.horizon for item in found} == set(facts.horizons)
    for item in found:
        assert item.share.sum() + item.outside == pytest.approx(1.0)
    assert all(item.outside <= 0.011 for item in found if item.model == NETWORK)


def test_horizon_curves_are_in_milliseconds(facts):
    curve = figures.horizon_curves(facts)[NETWORK]
    assert [x for x, _ in curve] == [10.0, 50.0, 100.0]
    assert curve[-1][1] == facts.models[NETWORK].overall["10"]["mean"]["rmse"]


def test_recordings_are_sorted_by_the_networks_error(facts):
    order, errors = figures.recording_errors(facts, 10)
    assert errors[NETWORK] == sorted(errors[NETWORK])
    assert sorted(order) == sorted(facts.models[NETWORK].recordings)


def test_the_best_epoch_is_the_last_one_marked(facts):
    tables = ({"epoch": 1, "best": True}, {"epoch": 2, "best": True, "train_loss": float("nan")}, {"epoch": "3"})
    rows = tuple(map(HistoryRow.from_table, tables))
    losses = learning_chart(dataclasses.replace(facts, history=rows)).panels[0].marks
    assert losses[0].x == 2
    assert (losses[1].x, losses[1].y) == ([1, 2, 3], [None, None, None])


def test_log_ticks_cover_the_values():
    ticks = figures.log_ticks([0.06, None, 0.93])
    assert {0.1, 0.2, 0.5} <= {round(tick, 9) for tick in ticks}
    assert figures.log_ticks([0.0, 1.0]) == []


def test_few_of_many_horizons_keep_both_ends():
    assert figures.some_of(list(range(1, 51)), 4)[::3] == [1, 50]
    assert figures.some_of([3, 4], 4) == [3, 4]


def test_colours_mean_the_same_in_every_figure(facts):
    seen: dict[str, set[str]] = {}
    for name, plot in plots_of(facts).items():
        for trace in plot.figure.data:
            if name != "learning" and trace.type == "scatter":
                seen.setdefault(trace.name, set()).add(trace.line.color)
    assert seen["Hybrid TCN-LSTM"] == {BLUE}
    assert seen["Measured"] == {GREY}
    assert all(len(colours) == 1 for colours in seen.values())


def test_each_choice_shows_one_recording_horizon_and_extent(facts):
    plot = plots_of(facts)["predictions"]
    shown = [trace for trace in plot.figure.data if trace.visible]
    assert len(shown) == 3 * len(facts.targets)  # truth and two models
    assert {trace.meta["recording"] for trace in shown} == {"trench_01"}
    assert {trace.meta.get("horizon") for trace in shown} == {None, "10"}


def test_many_recordings_become_a_rank_curve(facts):
    recordings = {f"r{i:03d}": {"10": {"mean": {"rmse": float(i)}}} for i in range(60)}
    models = {"network": ModelScores(label="N", overall={}, recordings=recordings)}
    scores = dataclasses.replace(facts.scores, models=models)
    plot = plots_of(dataclasses.replace(facts, scores=scores))["recordings"]
    assert list(plot.figure.data[0].x) == list(range(1, 61))


def test_one_horizon_becomes_bars(facts):
    task = dataclasses.replace(facts.scores.task, horizons=(10,))
    scores = dataclasses.replace(facts.scores, task=task)
    plot = plots_of(dataclasses.replace(facts, scores=scores, predictions={}))["horizon"]
    assert plot.figure.data[0].type == "bar"
    assert len(plot.figure.data[0].x) == len(facts.models)
