"""Runs beside each other: what is common, paired intervals, refusals, the page, the command and Python."""

import json
import shutil

import pytest
from browser import check_page, page_faults
from page_text import check_text
from safetensors.numpy import load_file, save_file
from typer.testing import CliRunner

import edp
from edp.cli import app
from edp.errors import ConfigError, DataError, EdpError, StorageError
from edp.report import build_compare_page, compare_runs
from edp.report.compare.page import error_table, model_table
from edp.report.compare.runs import MEAN
from edp.storage import write_json

HORIZONS = (1, 5, 10)
HOSTILE = "</script><img src=x onerror=alert(1)>"


def changed(folder, name, factors):
    """A copy of a run whose errors are those of the first, times a factor a recording."""
    other = folder.parent / name
    shutil.copytree(folder, other)
    scores = json.loads((other / "scores.json").read_text())
    recordings = scores["models"]["network"]["recordings"]
    by_name = dict(zip(recordings, factors, strict=True))
    for recording, by_horizon in recordings.items():
        for values in by_horizon.values():
            values["mean"]["mae"] *= by_name[recording]
    write_json(other / "scores.json", scores)
    arrays = load_file(other / "predictions.safetensors")
    for key in list(arrays):
        recording, _, part = key.partition("/")
        if part == "network":
            predicted, truth = arrays[key].copy(), arrays[f"{recording}/truth"]
            for column, k in enumerate(HORIZONS):
                predicted[:-k, column] = truth[k:] + by_name[recording] * (predicted[:-k, column] - truth[k:])
            arrays[key] = predicted
    save_file(arrays, other / "predictions.safetensors")
    return other


@pytest.fixture
def pair(make_run):
    run = make_run("first", recordings=6)
    return run, changed(run, "second", [0.80, 0.85, 0.78, 0.82, 0.79, 0.84])


def rewritten(folder, change):
    scores = json.loads((folder / "scores.json").read_text())
    change(scores)
    write_json(folder / "scores.json", scores)


def test_a_run_with_less_error_everywhere_is_told_apart(pair):
    comparison = compare_runs(pair)
    assert len(comparison.recordings) == 6
    assert [(m.output, m.ahead_s) for m in comparison.measures] == [(MEAN, 0.1), (MEAN, 0.05), (MEAN, 0.01)]
    difference = comparison.differences(comparison.measures[0])["second"]
    assert difference.told_apart
    assert difference.over == "recordings"
    assert difference.better == difference.count == 6
    assert -0.25 < difference.low < difference.change < difference.high < -0.1
    assert "second has" in comparison.headline()
    assert "less error (95 % interval" in comparison.headline()


@pytest.mark.parametrize(("recordings", "samples"), [(6, None), (1, 9000)])
def test_two_equal_runs_are_not_distinguishable(make_run, recordings, samples):
    run = make_run("first", recordings=recordings, **({"samples": samples} if samples else {}))
    comparison = compare_runs([run, shutil.copytree(run, run.parent / "second")])
    for measure in comparison.measures:
        difference = comparison.differences(measure)["second"]
        assert (difference.p, difference.change, difference.told_apart) == (1.0, 0.0, False)
    assert "second is not distinguishable (0.0 %" in comparison.headline()


def test_a_difference_of_rounding_is_not_told_apart(make_run):
    run = make_run("first", recordings=6)
    comparison = compare_runs(
        [run, changed(run, "second", [1 - 1e-7, 1 - 2e-7, 1 - 1e-7, 1 - 2e-7, 1 - 1e-7, 1 - 2e-7])]
    )
    assert not comparison.differences(comparison.measures[0])["second"].told_apart


def test_the_interval_is_that_of_a_paired_t_test(pair):
    from scipy.stats import ttest_rel

    comparison = compare_runs(pair)
    measure = comparison.measures[0]
    base, own = (comparison.errors(run, measure) for run in comparison.runs)
    known = ttest_rel(own, base)
    difference = comparison.differences(measure)["second"]
    ends = known.confidence_interval(0.95)
    assert difference.p == pytest.approx(known.pvalue, rel=1e-6)
    assert (difference.low, difference.high) == pytest.approx((ends.low / base.mean(), ends.high / base.mean()))


def test_what_goes_both_ways_is_not_told_apart(make_run):
    run = make_run("first", recordings=6)
    comparison = compare_runs([run, changed(run, "second", [1.3, 0.7, 1.2, 0.8, 1.1, 0.9])])
    assert not comparison.differences(comparison.measures[0])["second"].told_apart
    assert "second is not distinguishable" in comparison.headline()


def test_p_values_are_adjusted_for_the_number_of_runs(make_run):
    run = make_run("first", recordings=6)
    factors = [0.9, 1.02, 0.93, 0.99, 0.9, 0.95]
    two = compare_runs([run, changed(run, "second", factors)])
    alone = two.differences(two.measures[0])["second"].p
    three = compare_runs([run, run.parent / "second", changed(run, "third", [1.0, 1.01, 0.99, 1.0, 1.01, 0.99])])
    assert three.differences(three.measures[0])["second"].p == pytest.approx(2 * alone)


def test_a_run_judged_on_fewer_recordings_is_compared_on_the_common_ones(pair):
    rewritten(pair[1], lambda scores: scores["models"]["network"]["recordings"].pop("trench_03"))
    comparison = compare_runs(pair)
    assert len(comparison.recordings) == 5
    assert any("first was judged on 6 recordings" in line and "trench_03" in line for line in comparison.remarks)


def test_one_common_recording_is_compared_in_blocks(make_run):
    run = make_run("first", recordings=1, samples=9000)
    comparison = compare_runs([run, changed(run, "second", [0.8])])
    difference = comparison.differences(comparison.measures[0])["second"]
    assert difference.over == "blocks"
    assert difference.count == 9  # of 10 s
    assert difference.change == pytest.approx(-0.2, abs=0.02)
    assert difference.told_apart
    assert any("cannot speak for other recordings" in line for line in comparison.remarks)


def test_too_little_in_common_has_no_interval(make_run):
    run = make_run("first", recordings=2)
    comparison = compare_runs([run, changed(run, "second", [0.8, 0.8])])
    difference = comparison.differences(comparison.measures[0])["second"]
    assert (difference.low, difference.p, difference.told_apart) == (None, None, False)
    assert "–" in error_table(comparison, comparison.measures[0]).texts()[1]


def test_outputs_of_several_units_stand_alone(pair):
    def mixed(scores):
        scores["targets"][0]["unit"] = "deg/s"
        for by_horizon in scores["models"]["network"]["recordings"].values():
            for values in by_horizon.values():
                values |= {target["name"]: {"mae": values["mean"]["mae"]} for target in scores["targets"]}

    for run in pair:
        rewritten(run, mixed)
    comparison = compare_runs(pair)
    assert {measure.output for measure in comparison.measures} == {"CylVels_1", "CylVels_2", "CylVels_3"}
    assert {m.unit for m in comparison.measures if m.output == "CylVels_1"} == {"deg/s"}
    assert "of CylVels_1" in comparison.headline()


def test_recordings_of_one_name_with_other_values_are_refused(pair):
    arrays = load_file(pair[1] / "predictions.safetensors")
    arrays["trench_02/truth"] = arrays["trench_02/truth"] + 0.01
    save_file(arrays, pair[1] / "predictions.safetensors")
    with pytest.raises(DataError, match="trench_02"):
        compare_runs(pair)


def test_what_cannot_be_compared_is_refused_with_a_reason(pair, tmp_path):
    with pytest.raises(ConfigError, match="1 run"):
        compare_runs(pair[:1])
    with pytest.raises(ConfigError, match="twice"):
        compare_runs([pair[0], pair[0]])
    with pytest.raises(StorageError, match="no run folder"):
        compare_runs([pair[0], tmp_path / "nothing"])
    (pair[1] / "scores.json").unlink()
    with pytest.raises(DataError, match="edp evaluate"):
        compare_runs(pair)


def test_nothing_in_common_is_refused(pair):
    def other_name(scores):
        recordings = scores["models"]["network"]["recordings"]
        scores["models"]["network"]["recordings"] = {"other": recordings["trench_01"]}

    rewritten(pair[1], other_name)
    with pytest.raises(DataError, match="no test recording in common"):
        compare_runs(pair)
    rewritten(pair[1], lambda scores: scores["task"].update(rate_hz=77.0))
    with pytest.raises(DataError, match="common to all"):
        compare_runs(pair)


def test_twins_are_not_compared_with_networks(pair):
    (pair[1] / "free_run.json").write_text("{}")
    with pytest.raises(EdpError):
        compare_runs(pair)


@pytest.mark.parametrize("content", ["[]", "{"])
def test_a_damaged_footprint_is_one_error(pair, content):
    (pair[1] / "footprint.json").write_text(content)
    with pytest.raises(StorageError, match=r"footprint\.json"):
        compare_runs(pair)


def test_each_value_of_another_form_in_a_footprint_is_told(pair):
    odd = '{"budget": 3, "estimates": [1, {"cycles": "x"}], "parameters": "many"}'
    (pair[1] / "footprint.json").write_text(odd)
    with pytest.raises(StorageError, match=r"(?s)footprint\.json.*budget.*remove it and run edp evaluate") as told:
        compare_runs(pair)
    assert all(word in str(told.value) for word in ("estimates", "parameters"))


def test_names_stay_text(pair):
    other = pair[1].rename(pair[1].with_name("a <b>&"))
    rewritten(other, lambda scores: scores["models"]["network"].update(label=HOSTILE))
    for run in (pair[0], other):

        def renamed(scores):
            recordings = scores["models"]["network"]["recordings"]
            recordings[HOSTILE] = recordings.pop("trench_06")

        rewritten(run, renamed)
    page = build_compare_page(compare_runs([pair[0], other])).html()
    assert HOSTILE not in page
    assert "<b>&" not in page
    assert page.count("<script>") == 2


@pytest.mark.long
def test_the_command_prints_tables_and_writes_the_page(pair, tmp_path):
    page = tmp_path / "out" / "compare.html"
    result = CliRunner().invoke(app, ["compare", *map(str, pair), "--out", str(page)])
    assert result.exit_code == 0, result.output
    assert "95 % interval" in result.output
    assert page.is_file()
    result = CliRunner().invoke(app, ["compare", *map(str, pair), "--out", str(page), "--json"])
    facts = json.loads(result.stdout)
    assert facts["errors"][1]["run"] == "second"
    assert facts["errors"][1]["change"] < 0
    assert len(facts["recordings"]) == 6


def test_python_gives_a_frame_and_a_page(pair, tmp_path):
    compared = edp.compare(*pair)
    frame = compared.to_pandas()
    assert list(frame["run"].unique()) == ["first", "second"]
    assert frame[frame.run == "second"].change.lt(0).all()
    assert "second has" in repr(compared)
    assert compared.report(tmp_path / "page.html").is_file()
    assert len(compared.recordings) == 6


def test_costs_of_all_runs_are_listed(pair):
    sheet = model_table(compare_runs(pair))
    assert [column.heading for column in sheet.columns][:3] == ["Run", "Model", "Parameters"]
    assert sheet.texts()[0][2] == "41,283"


def test_the_text_of_the_page(pair):
    check_text(build_compare_page(compare_runs(pair)).html(), "compare")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, pair, tmp_path):
    check_page(browser, build_compare_page(compare_runs(pair)).write(tmp_path / "compare.html"), "comparison")


@pytest.mark.processes
def test_numbers_of_an_axis_are_never_cut_short(browser, make_run, tmp_path):
    first, second = make_run("first"), make_run("second")
    browser.open(build_compare_page(compare_runs([first, second])).write(tmp_path / "compare.html"))
    browser.run("window.dispatchEvent(new Event('beforeprint'))")
    assert [fault for fault in page_faults(browser) if "number cut short" in fault] == []
