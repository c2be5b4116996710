"""Predictions along a whole log, and the animation that shows them."""

import json
import re

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from edp.cli import app
from edp.errors import ConfigError
from edp.logs import write_recording
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.training.bundle import make_bundle, save_bundle
from edp.workflows.live.forecasts import forecast_lines


@pytest.fixture
def run(tiny, tiny_model, tmp_path):
    torch.manual_seed(0)
    predictor = Predictor(tiny.task, tiny_model, tiny.scaler()).eval()
    return predictor, save_bundle(make_bundle(predictor, tiny), tmp_path / "run" / "bundle").parent


def recording_of(tiny) -> Recording:
    """The rows of a test, with the angles of a front that moves a little."""
    rows = tiny.test[0].inputs
    swing = 0.1 * np.sin(np.arange(len(rows)) / 40.0)
    angles = np.stack([0.5 + swing, -1.2 + swing, -0.8 + swing], axis=1)
    velocities = np.zeros((len(rows), 3))
    channels = (
        *tiny.inputs,
        *(Channel(f"JointAngle_{i}", Kind.ANGLE) for i in (1, 2, 3)),
        *(Channel(f"CylVels_{i}", Kind.VELOCITY) for i in (1, 2, 3)),
    )
    values = np.hstack([rows, angles, velocities]).astype(np.float32)
    return Recording("log", channels, values, 100.0, source="sim:M22")


def test_a_prediction_stands_at_the_tick_for_which_it_was_made(tiny, run):
    predictor, folder = run
    recording = recording_of(tiny)
    expected = stream_predictions(predictor, tiny.test)[0]
    for position, ticks in enumerate(tiny.task.horizons):
        lines = forecast_lines(folder, recording, ticks)
        assert [line.unit for line in lines] == ["mm/s"] * 3
        for target, line in enumerate(lines):
            assert np.isnan(line.predicted[:ticks]).all()
            np.testing.assert_allclose(
                line.predicted[ticks:], 1e3 * expected[:-ticks, position, target], rtol=1e-3, atol=1e-2
            )
            np.testing.assert_allclose(line.measured, 1e3 * tiny.test[0].inputs[:, target], rtol=1e-5, atol=1e-4)
    assert forecast_lines(folder, recording)[0].name.endswith(f"{10 * max(tiny.task.horizons)} ms ahead")
    with pytest.raises(ConfigError, match=r"--horizon 7: this run predicts .* samples ahead"):
        forecast_lines(folder, recording, 7)


@pytest.mark.processes
def test_the_animation_of_a_run_and_a_log_shows_both(tiny, run, tmp_path):
    _, folder = run
    log, page = tmp_path / "log.parquet", tmp_path / "page.html"
    write_recording(recording_of(tiny), log)
    done = CliRunner().invoke(app, ["data", "animate", str(folder), str(log), "--out", str(page), "--json"])
    assert done.exit_code == 0, done.output
    data = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page.read_text(), re.DOTALL)
    scene = json.loads(data[1])
    assert len(scene["forecasts"]) == 3
    line = scene["forecasts"][0]
    assert line["predicted"][0] is None
    assert len(line["predicted"]) == len(line["measured"]) == len(scene["angles"][0])
    assert np.isfinite(line["predicted"][len(line["predicted"]) // 2 :]).all()
    alone = CliRunner().invoke(app, ["data", "animate", str(log), "--out", str(page)])
    assert alone.exit_code == 0, alone.output
    assert '"forecasts":[]' in page.read_text()


def test_what_cannot_be_shown_is_one_error(tiny, run, tmp_path):
    _, folder = run
    log = tmp_path / "log.parquet"
    write_recording(recording_of(tiny), log)
    for words, text in (
        ((folder, log, "--out", tmp_path / "a.gif"), "drawn on a page"),
        ((log, "--horizon", "1"), "--horizon: it has no effect without a run before the log"),
        ((folder, log, log), "3 paths were given"),
    ):
        done = CliRunner().invoke(app, ["data", "animate", *map(str, words)])
        assert done.exit_code != 0
        assert text in str(done.exception) + done.output
