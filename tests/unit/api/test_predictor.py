"""From recordings to a predictor that is judged, drawn, exported and streamed."""

import gc
import json

import numpy as np
import pytest
import torch

import edp
from edp.errors import BundleError, ConfigError, DataError, StorageError
from edp.export import TARGETS
from edp.training import Diverged
from edp.workflows.train_evaluate import build_report, evaluate


def test_a_run_on_disk_is_what_the_commands_work_on(rig_model, rig):
    folder = rig_model.folder
    assert sorted(path.name for path in (folder / "recordings").iterdir()) == [f"0000{i}.parquet" for i in range(4)]
    provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    assert provenance["data"]["test"]["names"] == ["recording_3"]
    assert evaluate(folder, baselines=["persistence"]) == folder
    assert build_report(folder).is_file()
    again = edp.load(folder)
    assert (again.inputs, again.targets, again.horizons, again.rate_hz) == (
        ("lever", "speed"),
        ("speed",),
        (2, 5),
        100.0,
    )
    assert again.units == {"lever": "1", "speed": "m/s"}
    np.testing.assert_array_equal(again.predict(rig).values[0], rig_model.predict(rig).values[0])


def test_a_finished_training_is_read_again_and_another_one_refused(rig_model, rig, tiny_settings):
    settings = tiny_settings | {"model.output": {"kind": "quantiles"}, "training.loss": {"kind": "quantile"}}
    same = edp.train(rig[:3], ["speed"], [2, 5], test=rig[3:], out=rig_model.folder, preset="quick", settings=settings)
    assert same.folder == rig_model.folder
    with pytest.raises(StorageError, match="holds another run"):
        edp.train(rig[:3], ["speed"], [2], test=rig[3:], out=rig_model.folder, preset="quick", settings=settings)


def test_a_training_without_a_folder_leaves_nothing_behind(rig, tiny_settings):
    model = edp.train(rig, targets=["speed"], preset="quick", settings=tiny_settings)
    folder = model.folder
    assert model.evaluate(baselines=[]).folder == folder
    assert (folder / "bundle").is_dir()
    del model
    gc.collect()
    assert not folder.exists()


def test_one_recording_is_divided_in_time(tiny_settings, rig):
    model = edp.train(rig[0], targets=["speed"], horizons=[1], preset="quick", settings=tiny_settings)
    assert list(model.evaluate(baselines=[]).to_dict()["models"]) == ["network"]


def test_scores_are_tables_frames_and_figures(rig_model, rig):
    scores = rig_model.evaluate()
    assert set(scores.to_dict()["models"]) == {"network", "persistence", "ridge_arx"}
    shown = repr(scores.table())
    assert "MAE" in shown
    assert "[mm/s]" in shown
    assert max(map(len, shown.splitlines())) <= 80
    assert "Ridge ARX" in shown
    assert "<table>" in scores._repr_html_()
    frame = scores.to_pandas()
    assert len(frame) == 6
    assert {"horizon", "model", "mae", "mae speed"} <= set(frame.columns)
    assert scores.to_polars().shape == frame.shape
    assert len(scores.plot().data) == 3
    other = rig_model.evaluate(rig[:2], baselines=["persistence"])
    assert other.folder != scores.folder
    assert set(other.to_dict()["models"]["network"]["recordings"]) == {"recording_0", "recording_1"}


def test_predictions_have_intervals_frames_and_figures(rig_model, rig):
    predictions = rig_model.predict(rig)
    assert len(predictions) == 4
    assert predictions.to_numpy()[0].shape == (400, 2, 1)
    widest = predictions.coverages[0]
    frame = predictions.to_pandas()
    assert len(frame) == 1600
    lower, upper = (frame[f"speed+5 {side} {widest:g}"] for side in ("lower", "upper"))
    assert (lower <= frame["speed+5"]).all()
    assert (frame["speed+5"] <= upper).all()
    assert predictions.to_polars().columns == list(frame.columns)
    assert "recording_3" in predictions._repr_html_()
    assert {trace.name for trace in predictions.plot("recording_1", horizon=2).data} == {
        "Interval",
        "Measured",
        "Predicted",
    }
    with pytest.raises(ConfigError, match="horizon = 3; this predictor has 2, 5"):
        rig_model.plot(rig, horizon=3)
    with pytest.raises(DataError, match="no predictions of 'recording_7'"):
        predictions.plot("recording_7")
    with pytest.raises(DataError, match="predictions of 4"):
        predictions.plot(4)


def test_what_is_drawn_stands_at_the_time_that_it_speaks_of(rig_model, rig):
    predictions = rig_model.predict(rig[0])
    line = next(trace for trace in predictions.plot(horizon=5).data if trace.name == "Predicted")
    assert line.x[0] == pytest.approx(0.05)
    np.testing.assert_allclose(line.y, 1e3 * predictions.values[0][:-5, 1, 0], rtol=1e-5)


def test_predictions_need_no_targets(rig, tiny_settings):
    model = edp.train(
        rig,
        ["speed"],
        [2],
        features=["lever"],
        preset="quick",
        settings=tiny_settings | {"task.mode": "absolute", "model.blocks": []},
    )
    levers = edp.Recordings.from_arrays(rig[0].values[:, :1], rate_hz=100, names=["lever"])
    predictions = model.predict(levers)
    assert {trace.name for trace in predictions.plot().data} == {"Predicted"}
    with pytest.raises(DataError, match="no channel 'speed'"):
        model.evaluate(levers)


def test_the_stream_says_tick_by_tick_what_predict_says(rig_model, rig):
    stream = rig_model.stream()
    assert isinstance(stream, edp.Stream)
    ticks = [stream.step(row).prediction for row in rig[0].select(rig_model.inputs)[:50]]
    np.testing.assert_allclose(ticks, rig_model.predict(rig[:1]).values[0][:50], rtol=1e-4, atol=1e-6)


def test_the_network_gives_what_predict_gives_whole_and_in_two_parts(rig_model, rig):
    network, recording = rig_model.network, rig[0]
    assert isinstance(network, torch.nn.Module)
    assert not network.training
    x = torch.from_numpy(recording.select(rig_model.inputs).copy())[None]
    with torch.no_grad():
        whole, _ = network.predict(x, network.initial_state(1, like=x))
        first, state = network.predict(x[:, :150], network.initial_state(1, like=x))
        second, _ = network.predict(x[:, 150:], state)
        standardised, _ = network(x, network.initial_state(1, like=x))
    assert whole.shape == standardised.shape == (1, recording.samples, len(rig_model.horizons), len(rig_model.targets))
    np.testing.assert_allclose(whole[0].numpy(), rig_model.predict(recording).values[0], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(torch.cat([first, second], dim=1).numpy(), whole.numpy(), rtol=1e-4, atol=1e-6)
    assert not np.allclose(standardised.numpy(), whole.numpy())


@pytest.mark.parametrize("target", list(TARGETS))
def test_every_export_target_is_written(rig, tiny_settings, target, tmp_path, point_model):
    options = {"binaries": "none"} if target == "fmu" else {}
    files = point_model.export(target, tmp_path / "out", name="rig", **options)
    assert files
    assert all(path.is_file() for path in files)


@pytest.fixture(scope="module")
def point_model(tmp_path_factory, tiny_settings):
    drives = np.cumsum(np.random.default_rng(0).normal(size=(3, 200, 2)), axis=1)
    data = edp.Recordings.from_arrays(drives, rate_hz=50, names=["a", "b"])
    return edp.train(
        data, ["b"], [1], out=tmp_path_factory.mktemp("point") / "run", preset="quick", settings=tiny_settings
    )


def test_unknown_targets_options_and_folders_are_one_error(point_model, tmp_path):
    with pytest.raises(ConfigError, match="unknown export target 'd'"):
        point_model.export("d", tmp_path / "out")
    with pytest.raises(ConfigError, match="has no option 'speed'"):
        point_model.export("c", tmp_path / "out", speed=1)
    with pytest.raises(BundleError, match="not a bundle"):
        edp.load(tmp_path)


def test_a_bundle_alone_is_judged_without_baselines(point_model, rig_model, rig):
    alone = edp.load(rig_model.folder / "bundle")
    scores = alone.evaluate(rig[3:])
    whole = rig_model.evaluate(rig[3:])
    ours, theirs = (part.to_dict()["models"]["network"]["overall"] for part in (scores, whole))
    assert ours == theirs
    assert "mm/s" in repr(scores.table())
    with pytest.raises(ConfigError, match="give the recordings"):
        alone.evaluate()
    with pytest.raises(ConfigError, match="leave baselines out"):
        alone.evaluate(rig[3:], baselines=["persistence"])


def test_a_predictor_shows_what_it_reads_and_predicts(point_model):
    assert "50 Hz" in repr(point_model)
    assert "<table>" in point_model._repr_html_()


def test_hostile_names_stay_text_in_everything_that_is_shown(tiny_settings):
    drives = np.cumsum(np.random.default_rng(0).normal(size=(3, 200, 2)), axis=1)
    names = ["<script>a</script>", "<img src=x onerror=alert(1)>"]
    recordings = [f"<b>{i}" for i in range(3)]
    data = edp.Recordings.from_arrays(drives, rate_hz=50, names=names, recording_names=recordings)
    model = edp.train(data, [names[1]], [1], preset="quick", settings=tiny_settings)
    scores = model.evaluate(data, baselines=[])
    predictions = model.predict(data)
    for shown in (model, scores, scores.table(), predictions):
        assert not {"<script", "<img", "<b>0"} & set(shown._repr_html_().split(">"))
        assert "<script" not in shown._repr_html_()
        assert "<img" not in shown._repr_html_()
    for figure in (scores.plot(), predictions.plot(), data.plot()):
        assert "<script" not in figure.to_json().replace("\\u003c", "<")
        assert "<img" not in figure.to_json().replace("\\u003c", "<")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"targets": ["sped"]}, (DataError, ConfigError), "'?sped'?.*did you mean 'speed'"),
        ({"targets": []}, ConfigError, "no targets"),
        ({"targets": "speed"}, ConfigError, "give a list of names"),
        ({"horizons": [0]}, ConfigError, "horizon 0"),
        ({"horizons": []}, ConfigError, "horizons"),
        ({"horizons": 10}, ConfigError, r"such as \[10\]"),
        ({"features": "FG9"}, ConfigError, "no feature set 'FG9'"),
        ({"features": ["lever", "speeed"]}, (DataError, ConfigError), "speed"),
        ({"preset": "fast"}, ConfigError, "no preset 'fast'"),
        ({"settings": {"training.epoch": 1}}, ConfigError, "epoch"),
        ({"settings": {"task.targets": ["lever"]}}, ConfigError, "argument `targets`"),
        ({"data": 5}, DataError, "the data is a int"),
        ({"data": []}, DataError, "no recordings"),
    ],
)
def test_what_cannot_be_trained_is_one_error(rig, tiny_settings, options, error, message):
    chosen = {"data": rig, "targets": ["speed"], "preset": "quick", "settings": tiny_settings, **options}
    with pytest.raises(error, match=message):
        edp.train(**chosen)


def test_a_split_and_a_test_set_are_not_both_taken(rig, tiny_settings):
    with pytest.raises(ConfigError, match="leave one of them out"):
        edp.train(
            rig[:3], ["speed"], test=rig[3:], preset="quick", settings=tiny_settings | {"split": {"kind": "time"}}
        )


def test_arrays_of_both_parts_may_have_the_same_names(tiny_settings, rig):
    model = edp.train(rig[:2], ["speed"], [2], test=edp.Recordings([rig[0]]), preset="quick", settings=tiny_settings)
    assert list(model.evaluate(baselines=[]).to_dict()["models"]["network"]["recordings"]) == ["test recording_0"]


def test_recordings_that_are_too_short_are_one_error(tiny_settings, rig):
    with pytest.raises(DataError, match="too short"):
        edp.train(rig[0].rows(0, 15), ["speed"], preset="quick", settings=tiny_settings)


def test_missing_values_in_what_is_read_are_one_error(tiny_settings):
    values = np.random.default_rng(0).normal(size=(3, 100, 2))
    values[1, 50, 0] = np.nan
    data = edp.Recordings.from_arrays(values, rate_hz=50, repair={"nan": "keep"})
    with pytest.raises(DataError, match="'channel_0' has 1 missing"):
        edp.train(data, ["channel_1"], [1], preset="quick", settings=tiny_settings)


def test_other_rates_and_missing_inputs_are_one_error(rig_model, rig):
    slow = edp.Recordings.from_arrays(np.zeros((50, 2)), rate_hz=50, names=["lever", "speed"])
    with pytest.raises(DataError, match="50 Hz, the task 100 Hz"):
        rig_model.predict(slow)
    with pytest.raises(DataError, match="no channel 'lever'"):
        rig_model.predict(edp.Recordings.from_arrays(np.zeros((50, 1)), rate_hz=100, names=["speed"]))
    with pytest.raises(DataError, match="no tick of the test recordings can be scored"):
        rig_model.evaluate(rig[0].rows(0, 14))


def test_a_training_that_diverges_keeps_its_folder(rig, tiny_settings, tmp_path):
    settings = tiny_settings | {"training.optimizer": {"kind": "adamw", "learning_rate": 1e30}, "training.epochs": 3}
    with pytest.raises(Diverged):
        edp.train(rig, ["speed"], [2], out=tmp_path / "run", preset="quick", settings=settings)
    assert json.loads((tmp_path / "run" / "status.json").read_text(encoding="utf-8"))["status"] == "diverged"
