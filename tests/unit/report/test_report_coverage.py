"""The page of what a data set covers: offline, whole or with parts missing, whatever the names."""

import json

import numpy as np
import pytest
from browser import check_page
from page_text import check_text

from edp.data.coverage import cover
from edp.data.splits import ByTime
from edp.recording import Recording
from edp.report import build_coverage_page
from edp.report.common.interactive import plots
from edp.report.coverage.charts import coverage_charts
from edp.report.coverage.page import headline, verdict
from edp.signals import EXTRA_CHANNELS, TABLE_A1, VOCABULARY, Channel, Kind

pytestmark = pytest.mark.long


def machine_like(names=(*TABLE_A1, *EXTRA_CHANNELS), samples=4000):
    rng = np.random.default_rng(0)
    sizes = [{"pressure": 1e7, "pilot_pressure": 1e6}.get(VOCABULARY[name].kind, 0.1) for name in names]
    values = np.cumsum(rng.normal(size=(samples, len(names))), axis=0) / 30.0 * sizes
    meta = {"full_strokes_m": [1.2, 1.5, 1.1]}
    return Recording("r", tuple(VOCABULARY[n] for n in names), values.astype(np.float32), 100.0, "", meta)


def figures_of(text):
    specs = text.split('id="figures">')[1].split("</script>")[0]
    return {spec["name"]: spec["figure"] for spec in json.loads(specs)}


def test_the_page_shows_every_picture_and_loads_nothing(tmp_path):
    recording = machine_like()
    found = cover([recording], split=ByTime().split([recording], 10))
    path = build_coverage_page(found, "a <b>data</b> set").write(tmp_path / "coverage.html")
    text = path.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert text.count("const Figure = ") == 1
    assert len(text) < 1e6
    assert "://" not in text.split("<script>")[0]
    assert "a &lt;b&gt;data&lt;/b&gt; set" in text
    names = ["spectrum", "excitation", "occupancy", "joint_command", "joint_head", "joint_rod", "joint_velocities"]
    assert list(figures_of(text)) == names == list(plots(coverage_charts(found)))
    assert all(f'id="figure-{name}"' in text for name in names)
    assert "Not examined" not in text
    for words in ("Reversals", "Both pumps shared", "Power limit", "From test to training", "of 216 cells", "not met"):
        assert words in text


def test_six_maps_show_every_cell_of_three_strokes():
    found = cover([machine_like()])
    figure = plots(coverage_charts(found))["occupancy"].figure
    assert len(figure.data) == 6
    total = sum(np.nansum(trace.customdata) for trace in figure.data)
    assert total == pytest.approx(100.0)
    empty = sum(entry is None for trace in figure.data for row in trace.z for entry in row)
    assert empty == np.count_nonzero(found.occupancy.samples == 0)


@pytest.mark.parametrize(
    ("channels", "absent"),
    [
        ({"v": Kind.VELOCITY}, "No channel of these recordings is known to command"),
        ({"u": Kind.VOLTAGE}, "Not examined"),
        ({"v": Kind.VELOCITY, "u": Kind.CURRENT, "x": Kind.POSITION}, "The full strokes are not known"),
        ({"a": Kind.VELOCITY, "b": Kind.VELOCITY, "</script>": Kind.RATIO}, "velocities were integrated"),
    ],
)
def test_what_a_recording_lacks_is_said_and_no_name_breaks_the_page(channels, absent):
    values = np.cumsum(np.random.default_rng(1).normal(size=(2000, len(channels))), axis=0).astype(np.float32)
    recording = Recording("r", tuple(Channel(name, kind) for name, kind in channels.items()), values, 50.0)
    text = build_coverage_page(cover([recording]), "t").html()
    assert absent in text
    assert figures_of(text)
    assert "nan" not in json.dumps(figures_of(text)).lower().replace("nanmax", "")


def test_a_rig_without_strokes_has_no_sections_of_a_machine():
    recording = Recording("rig", (Channel("valve", Kind.VOLTAGE),), machine_like().values[:, :1].copy(), 100.0)
    text = build_coverage_page(cover([recording]), "rig").html().split("<script>")[0]
    for section in ("poses", "joint", "events"):
        assert f'id="{section}"' not in text
        assert f'href="#{section}"' not in text
    for word in ("Soil", "bucket", "Cavitation"):
        assert word not in text


def test_the_sentence_says_what_there_is():
    found = cover([machine_like()])
    assert headline(found).startswith("0.011 h of data" if found.hours < 0.01 else "0.01 h of data")
    assert "visits" in headline(found)
    assert any("cells were visited" in line for line in verdict(found))
    bare = cover([machine_like(names=("CylVels_1",), samples=50)])
    assert headline(bare).endswith("of the stroke.")


def test_the_text_of_the_page():
    recording = machine_like()
    found = cover([recording], split=ByTime().split([recording], 10))
    check_text(build_coverage_page(found, "data").html(), "coverage")


@pytest.mark.processes
def test_the_page_in_a_browser(browser, tmp_path):
    recording = machine_like()
    found = cover([recording], split=ByTime().split([recording], 10))
    page = build_coverage_page(found, "data").write(tmp_path / "coverage.html")
    check_page(browser, page, "coverage", ("Soil contact", "boom", "bucket"))
