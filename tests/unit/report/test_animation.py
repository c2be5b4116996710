"""Side views of recordings: what is drawn follows the linkage, pages need no network, films need ffmpeg."""

import dataclasses
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from browser import check_page
from typer.testing import CliRunner

from edp.cli import app
from edp.errors import ConfigError, DataError, StorageError
from edp.logs import write_recording
from edp.recording import Recording
from edp.report.animation import film
from edp.report.animation.page import scene_of, write_animation
from edp.report.animation.raster import Image
from edp.sim import Scenario, simulate

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def recording():
    return simulate(Scenario(duration_s=3.0, seed=2))


def only(recording, *kinds, **changes):
    keep = [c for c in recording.channels if c.name.startswith(kinds)]
    values = recording.select([c.name for c in keep]).copy()
    return Recording(recording.name, tuple(keep), values, recording.rate_hz, **changes)


def test_strokes_alone_give_the_same_picture(recording):
    with_angles = scene_of(recording)
    strokes = only(recording, "CylStroke")
    scene = scene_of(strokes, "M22")
    np.testing.assert_allclose(scene.angles, with_angles.angles, atol=1e-3)
    np.testing.assert_allclose(scene.velocity, with_angles.velocity, atol=20.0)
    assert scene.pressure.shape == (len(scene.angles), 0)
    with pytest.raises(ConfigError, match="--machine"):
        scene_of(strokes)


def test_missing_values_are_bridged(recording):
    holed = dataclasses.replace(recording, values=recording.values.copy())
    holed.values[50:60] = np.nan
    assert np.isfinite(scene_of(holed).angles).all()


def test_what_cannot_be_drawn_is_refused(recording):
    with pytest.raises(DataError, match=r"JointAngle_1.*CylStroke_1.*signal map"):
        scene_of(only(recording, "CylVels"), "M22")
    longer = only(recording, "CylStroke")
    longer.values[:, 1] += 2.0
    with pytest.raises(DataError, match=r"CylStroke_2.*arm cylinder of M22 from 0 to 1\.504 m"):
        scene_of(longer, "M22")
    for start, seconds in ((-1.0, None), (3.5, None), (0.0, 0.0), (0.0, float("nan"))):
        with pytest.raises(ConfigError, match="lasts 3 s"):
            scene_of(recording, start_s=start, seconds=seconds)


def test_the_page_needs_no_network_and_holds_the_scene(recording, tmp_path):
    named = dataclasses.replace(recording, name="</script><b>&")
    page = write_animation(scene_of(named), tmp_path / "a.html").read_text()
    assert not re.search(r"(src|href)\s*=|https?:|@import|url\(", page)
    assert "</script><b>" not in page
    data = json.loads(re.search(r'id="scene">(.*?)</script>', page, re.S)[1])
    assert len(data["angles"]) == len(data["velocity"]) == 3
    assert len(data["pressure"]) == 6
    assert len(data["angles"][0]) == 75


def test_frames_show_motion_and_the_charts(recording):
    scene = scene_of(recording, seconds=1.0)
    pictures = list(film.frames(scene))
    assert len(pictures) == len(scene.angles) == 25
    assert pictures[0].shape == (film.HEIGHT, film.WIDTH, 3)
    assert (pictures[0] != pictures[-1]).any()
    assert (pictures[0][:, film.CHART_LEFT :] < 128).any()


def test_polygons_fill_by_area():
    image = Image(40, 40)
    image.polygon(np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 20.0], [10.0, 20.0]]), (0, 0, 0))
    assert (255.0 - image.pixels()[:, :, 0]).sum() / 255.0 == pytest.approx(200.0, rel=0.08)
    image.polygon(np.array([[-90.0, -90.0], [-80.0, -90.0], [-80.0, -80.0]]), (9, 9, 9))
    image.line(np.array([[5.0, 5.0], [500.0, 5.0]]), (0, 0, 0), 1.0)
    image.text(30, 35, "9 ~", (0, 0, 0), 3)
    assert image.pixels()[5, 39].max() < 255


def test_without_ffmpeg_one_clear_message(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(StorageError, match=r"ffmpeg.*\.html"):
        film.write_film(scene_of(recording), tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
@pytest.mark.parametrize("ending", [".mp4", ".gif"])
def test_films(recording, tmp_path, ending):
    made = film.write_film(scene_of(recording, seconds=0.4), tmp_path / f"a{ending}")
    probe = [shutil.which("ffmpeg"), "-v", "error", "-i", str(made), "-f", "null", "-"]
    assert subprocess.run(probe, capture_output=True, check=True).stderr == b""


def test_the_command(recording, tmp_path):
    log = write_recording(only(recording, "Cyl", "Joint", source="sim:M22"), tmp_path / "one.parquet")
    done = CliRunner().invoke(app, ["data", "animate", str(log), "--seconds", "1", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["animation"].endswith("one.html")
    assert (tmp_path / "one.html").stat().st_size > 10_000
    wrong = CliRunner().invoke(app, ["data", "animate", str(log), "--out", str(tmp_path / "a.avi")])
    assert isinstance(wrong.exception, ConfigError)
    assert ".mp4" in str(wrong.exception)


def test_the_page_in_a_browser(browser, recording, tmp_path):
    check_page(browser, write_animation(scene_of(recording), tmp_path / "film.html"), "side view")
