"""The page and pictures of a screening: offline, whole or nearly empty, whatever the names."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from browser import check_page
from page_text import check_text

from edp.data.screening import (
    ChannelVerdict,
    Cluster,
    Flag,
    FlagKind,
    GroupImportance,
    LagCurve,
    Matrices,
    Proposal,
    ScreeningResult,
    Stability,
    Value,
)
from edp.evaluation.trials_file import FeatureSetTrial, PairedDifference, Trials
from edp.report import build_screening_page, write_screening_pictures
from edp.report.common.interactive import plots
from edp.report.common.picture import write_pictures
from edp.report.screening.charts import screening_charts
from edp.report.screening.page import headline, sentence, verdict
from edp.report.screening.views import lag_ranges, lag_views, matrix_views, stability_views

pytestmark = pytest.mark.long

NAMES = ("v", "u<b>", "late", "noise")
LAGS = np.arange(-20, 21)


def curve(channel, best, value, certain=True, at_edge=False):
    shape = value * np.exp(-0.5 * ((LAGS - best) / 6.0) ** 2)
    return LagCurve(channel, "v", "group", LAGS, shape, best, value, best - 1, best + 1, 1.0, certain, at_edge)


def screening(names=NAMES):
    """A screening of four channels, or of as many as there are names."""
    count = len(names)
    rng = np.random.default_rng(0)
    square = np.clip(rng.normal(size=(count, count)) / 3, -1, 1)
    np.fill_diagonal(square, 1.0)
    square[-1, :] = square[:, -1] = np.nan
    matrices = Matrices(tuple(names), square, square, square, np.abs(square) * 3)
    best = [0, -12, 5, 3]
    curves = [curve(name, best[i % 4], 0.9 - 0.2 * (i % 4), certain=i % 4 != 3) for i, name in enumerate(names)]
    metrics = ("pearson", "spearman", "kendall", "information", "lag")
    stable = tuple(
        Stability(metric, name, "v", rng.normal(size=5), 0.5 - 0.3 * (i % 4), 0.1, 0.9, 0.05)
        for metric in metrics
        for i, name in enumerate(names)
    )
    importance = tuple(
        GroupImportance((name,), target, 0.3 - 0.1 * (i % 4), 0.1 - 0.1 * (i % 4), 0.4, 0.25)
        for target in ("all", "v")
        for i, name in enumerate(names)
    )
    values = tuple(Value(name, "v", 0.1, -0.1, 0.2) for name in names[1:])
    flags = (
        Flag(names[2], FlagKind.LEAK, "v", -7, 0.99, "shows v 7 samples early"),
        Flag(names[3], FlagKind.NOISE, evidence="correlation at most 0.01"),
    )
    choices = tuple(
        ChannelVerdict(name, i < 2, i + 1, 1.0 - i / count, f"reason {i}", tuple(f for f in flags if f.channel == name))
        for i, name in enumerate(names)
    )
    proposal = Proposal(choices, 30, "the longest lead is 12 samples", ("one leak",))
    return ScreeningResult(
        ("r1", "r2"), ("p1", "p2"), 360_000, 100.0, tuple(names), ("group",) * count, ("v",), 10, matrices,
        tuple(curves), stable, importance, values, (Cluster(tuple(names[:2]), names[0], 0.93),), flags, proposal,
        {"horizon": 10}, {"reading": 0.5, "forest": 61.0},
    )  # fmt: skip


TRIALS = Trials(
    (
        FeatureSetTrial("proposed", ("v", "u"), 2, 1200, {"10": 4.2}, {"10": (4.2,)}, None, 1.0),
        FeatureSetTrial(
            "all", ("v",) * 4, 4, 1300, {"10": 4.5}, {"10": (4.5,)}, {"10": PairedDifference(0.3, 0.1, 0.5)}, 1.0
        ),
    ),
    {"10": 9.0},
    "mm/s",
    ("r7",),
    ("FG1 was not tried: the recordings lack BmUp",),
)


def figures_of(text):
    specs = text.split('id="figures">')[1].split("</script>")[0]
    return {spec["name"]: spec for spec in json.loads(specs)}


def test_the_page_shows_every_picture_and_loads_nothing(tmp_path):
    path = build_screening_page(screening(), "a <b>data</b> set", None, TRIALS, ["A note."]).write(
        tmp_path / "report.html"
    )
    text = path.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "://" not in text.split("<script>")[0]
    assert "a &lt;b&gt;data&lt;/b&gt; set" in text
    assert "u&lt;b&gt;" in text.split("<script>")[0]
    assert "<td>u<b></td>" not in text
    assert list(figures_of(text)) == ["matrices", "lags", "stability", "importance", "value"]
    assert all(f'id="figure-{name}"' in text for name in figures_of(text))
    for words in ("leak of the future", "4.200", "+0.10 to +0.50", "9.000", "lack BmUp", "A note.", "reason 3"):
        assert words in text
    assert "The longest lead is 12 samples." in text


def test_choices_above_the_figures_name_the_traces_that_they_show():
    for name, spec in figures_of(build_screening_page(screening(), "x").html()).items():
        keys = set(spec["controls"])
        for trace in spec["figure"]["data"]:
            assert keys <= set(trace.get("meta", {})), name
        if name == "matrices":
            assert [t["meta"]["measure"] for t in spec["figure"]["data"]] == [
                "spearman",
                "information",
                "pearson",
                "kendall",
            ]
            assert [t["visible"] for t in spec["figure"]["data"]] == [True, False, False, False]
    assert set(figures_of(build_screening_page(screening(), "x").html())["stability"]["controls"]) == {"metric"}


def test_headline_and_verdict():
    found = screening()
    assert headline(found) == "2 of 4 channels are proposed to predict v, with a memory of 30 samples (300 ms)."
    lines = verdict(found, None)
    assert "late knows the future and must not be fed to a model." in lines
    assert "The forest misses v most." in lines
    assert "One leak." in lines
    assert sentence("  done!") == "Done!"
    assert sentence("") == ""


def test_views_leave_out_what_says_nothing():
    found = screening()
    information = next(view for view in matrix_views(found) if view.measure == "information")
    assert np.isnan(np.diag(information.values)).all()
    assert np.isnan(information.values[-1]).all()
    (lags,) = lag_views(found)
    assert [entry.channel for entry in lags.curves] == ["u<b>", "late", "noise"]
    (row,) = lag_ranges(found)
    assert (row.low, row.high, row.certain, row.curves) == (-12, -12, 1, 1)  # v is the target, two are flagged
    (row,) = lag_ranges(found, ["u<b>", "late", "noise"])
    assert (row.low, row.high, row.certain, row.curves) == (-12, 5, 2, 3)
    pearson = stability_views(found)[2]
    assert pearson.key == "pearson"
    assert [bar.label for bar in pearson.bars] == ["noise", "u<b>", "late"]
    assert [math.copysign(1, bar.mark) for bar in pearson.bars] == [-1, 1, -1]
    assert [bar.proposed for bar in pearson.bars] == [False, True, False]


def test_pictures_are_written_in_two_formats(tmp_path):
    written = write_screening_pictures(screening(), tmp_path / "a")
    names = {path.name for path in written}
    assert len(written) == len(names) == 2 * (4 + 1 + 5 + 2)
    some = {"matrix_spearman.svg", "matrix_information.png", "lags_v.svg", "stability_lag.png", "value.svg"}
    assert some <= names
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in written if path.suffix == ".png")
    svg = (tmp_path / "a" / "matrix_spearman.svg").read_text(encoding="utf-8")
    assert "u&lt;b&gt;" in svg
    assert "Spearman rank correlation" in svg


@pytest.mark.parametrize("odd", ["$x_1$", "../up/and\\down", "µ" * 200, " ", "<script>"])
def test_names_that_mean_something_elsewhere(tmp_path, odd):
    found = screening((odd, "b", "c", "d"))
    curves = tuple(replace(entry, target=odd) for entry in found.lags)
    found = replace(found, targets=(odd,), lags=curves)
    assert "<script>;" not in build_screening_page(found, odd).html()
    lags = [chart for chart in screening_charts(found) if chart.name == "lags"]
    first, again = ([path.read_bytes() for path in write_pictures(tmp_path / part, lags)] for part in "ab")
    assert first == again
    assert len(list(tmp_path.rglob("*.svg"))) == 2


def test_a_screening_of_many_channels_stays_readable_and_small():
    names = ("v", *(f"channel_{i:03d}" for i in range(119)))
    text = build_screening_page(screening(names), "many").html()
    specs = figures_of(text)
    assert specs["matrices"]["figure"]["layout"]["height"] == 1500
    assert len(specs["lags"]["figure"]["data"]) == 2 * 16  # a curve and its best lag
    assert all(len(trace["y"]) <= 40 for trace in specs["stability"]["figure"]["data"])
    assert len(text) < 8_000_000


@pytest.mark.processes
def test_nothing_but_a_proposal_is_a_page_too():
    found = screening()
    bare = replace(found, lags=(), stability=(), importance=(), values=(), clusters=(), flags=())
    assert list(plots(screening_charts(bare))) == ["matrices"]
    text = build_screening_page(bare, "bare").html()
    assert 'id="flags"' not in text
    assert 'id="clusters"' not in text


def test_the_text_of_the_page():
    check_text(build_screening_page(screening(), "data", None, TRIALS, ["A note."]).html(), "screening")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, tmp_path):
    check_page(
        browser,
        build_screening_page(screening(), "data", None, TRIALS, ["A note."]).write(tmp_path / "report.html"),
        "screening",
    )
