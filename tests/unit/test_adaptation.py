"""A run with an adaptation: fitted, kept in its bundle, replayed, streamed, counted, and refused where it cannot be."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from edp.cli import app
from edp.config.experiment import load_experiment
from edp.data.twin_channels import TwinChannels
from edp.errors import BundleError, ConfigError, StorageError
from edp.ir.rls import AdaptationSpec, RlsStatus
from edp.networks import AdaptedStream
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.greybox import GreyBox
from edp.settings.provenance import Provenance
from edp.signals import Channel, Kind
from edp.storage import read_json, write_json
from edp.training import load_bundle, save_bundle, upgrade_bundle
from edp.training.bundle import ADAPTED_SCHEMA, HASH, SCHEMA, content_digest
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.workflows.adaptation import adapt, fit_adaptation, replay, replay_run
from edp.workflows.adaptation.with_twin import TwinMoves, choose_tuned_spec, correction_of
from edp.workflows.deployment import footprint_of
from edp.workflows.train_evaluate import evaluate, read_trained_run, train

SETTINGS = (
    'task.features={name="levers", channels=["speed", "lever"]}',
    'task.targets=["speed"]',
    "task.horizons=[2]",
    "training.epochs=1",
    "training.updates=4",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[4],kernel=2,units=4}',
    "model.head.hidden=4",
    "model.blocks=[]",
    "model.window=10",
    "evaluation.history=4",
    'evaluation.baselines=["persistence"]',
)
SPEC = AdaptationSpec(rank=1, noise=1.0)


@pytest.fixture(scope="module")
def run(lever_sessions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("source") / "run"
    train(lever_sessions, load_experiment(None, "quick", list(SETTINGS)), folder)
    return folder


@pytest.fixture(scope="module")
def adapted(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("adapted") / "run"
    return folder, adapt(run, folder, SPEC).adaptation


def test_its_numbers_are_those_of_the_runs_recordings(run, adapted):
    _, made = adapted
    bundle, _, _, data = read_trained_run(run)
    inputs = np.concatenate([part.inputs for part in data.train])
    np.testing.assert_allclose(made.offset, inputs.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(made.scale, inputs.std(axis=0), rtol=1e-4)
    assert made.columns == (bundle.task.inputs.index("speed"),)
    assert made.directions[0, made.columns[0]] == 0  # the target is a feature of its own
    lever = bundle.task.inputs.index("lever")
    np.testing.assert_allclose(abs(made.directions[0, lever]), 1.0, rtol=1e-3)  # the only other input, of spread 1
    assert made.middle[0] == 0  # a velocity at rest


def test_a_bundle_keeps_it_and_a_damaged_one_is_refused(run, adapted, tmp_path):
    folder, made = adapted
    bundle = load_bundle(folder)
    assert bundle.adaptation.digest == made.digest
    header = read_json(folder / "bundle" / "bundle.json")
    assert header["schema"] == ADAPTED_SCHEMA
    assert read_json(run / "bundle" / "bundle.json")["schema"] == SCHEMA
    assert load_bundle(run).adaptation is None
    copy = save_bundle(bundle, tmp_path / "copy")
    (arrays,) = copy.glob("adaptation-*.safetensors")
    arrays.write_bytes(arrays.read_bytes()[:-1] + b"x")
    with pytest.raises(BundleError, match="do not match their digest"):
        load_bundle(copy)
    save_bundle(bundle, copy)
    held = read_json(copy / "bundle.json")
    held["adaptation"]["horizons"] = [3]
    write_json(copy / "bundle.json", held | {HASH: content_digest(held)})
    with pytest.raises(BundleError, match="another task"):
        load_bundle(copy)
    save_bundle(dataclasses.replace(bundle, adaptation=None), copy)
    assert not list(copy.glob("adaptation-*"))


def test_an_adapted_bundle_of_the_former_words_is_upgraded_and_keeps_its_digest(adapted, tmp_path):
    folder, made = adapted
    copy = save_bundle(load_bundle(folder), tmp_path / "copy")
    held = read_json(copy / "bundle.json") | {"schema": 7}
    spec = held["adaptation"]["spec"]
    spec["rest"] = spec.pop("dead_zone")
    write_json(copy / "bundle.json", held | {HASH: content_digest(held)})
    with pytest.raises(BundleError, match=r"schema 7, .*upgrade_bundle"):
        load_bundle(copy)
    upgrade_bundle(copy)
    adaptation = load_bundle(copy).adaptation
    assert (adaptation.spec, adaptation.digest) == (made.spec, made.digest)


def test_a_stream_and_a_replay_give_the_same_numbers(run, adapted):
    folder, made = adapted
    bundle, data = load_bundle(folder), read_trained_run(run)[3]
    part = data.test[0]
    held = replay(bundle.predictor, made, [part]).recordings[0]
    stream = AdaptedStream(bundle.predictor, bundle.adaptation)
    found = []
    for row in part.inputs:
        found.append(stream.step(row).prediction)
        np.testing.assert_allclose(found[-1] - stream.correction, held.base[len(found) - 1], atol=1e-5)
    np.testing.assert_allclose(np.stack(found), held.adapted, atol=1e-4)
    assert np.abs(held.adapted - held.base).max() > 0
    assert stream.status is not RlsStatus.NONE
    theta = stream.adapter.theta.copy()
    stream.reset()
    np.testing.assert_array_equal(stream.adapter.theta, theta)  # what was learned stays
    stream.learn = False
    for row in part.inputs:
        stream.step(row)
    np.testing.assert_array_equal(stream.adapter.theta, theta)


def test_what_was_learned_can_be_carried_from_one_recording_to_the_next(run, adapted):
    _, made = adapted
    bundle, _, _, data = read_trained_run(run)
    alone, carried = (replay(bundle.predictor, made, data.train[:2], carry=carry) for carry in (False, True))
    np.testing.assert_array_equal(alone.recordings[0].adapted, carried.recordings[0].adapted)
    assert not np.array_equal(alone.recordings[1].adapted, carried.recordings[1].adapted)
    frozen = replay(bundle.predictor, made, data.train[:1], learn=False).recordings[0]
    np.testing.assert_array_equal(frozen.adapted, frozen.base)


def test_an_adapted_run_is_judged_and_counted_and_stays_adapted(run, adapted):
    folder, made = adapted
    evaluate(folder)
    assert load_bundle(folder).adaptation.digest == made.digest
    with_, without = footprint_of(folder)[0], footprint_of(run)[0]
    assert with_.macs_tick - without.macs_tick == made.macs
    assert with_.state_bytes - without.state_bytes == 4 * made.state_numbers
    assert read_json(folder / "footprint.json")["macs_tick"] == with_.macs_tick


def test_commands_say_what_it_is_worth(run, adapted, lever_sessions, tmp_path):
    folder, _ = adapted
    runner = CliRunner(env={"COLUMNS": "200"})
    done = runner.invoke(app, ["adapt", str(run), "--out", str(tmp_path / "a"), "--set", "adapt.rank=1", "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    assert facts["features"] == 5
    shown = runner.invoke(app, ["adapt", "replay", str(folder), str(lever_sessions.path), "--carry"])
    assert shown.exit_code == 0, shown.output
    assert "0 to 10" in shown.output
    assert "ticks taught" in shown.output
    onnx = runner.invoke(app, ["export", str(folder), "--to", "onnx", "--out", str(tmp_path / "onnx")])
    assert "holds the network alone" in onnx.output
    c = runner.invoke(app, ["export", str(folder), "--to", "c", "--out", str(tmp_path / "c")])
    assert "predictor_adaptation.h" in c.output
    assert "holds the network alone" not in c.output


def saved_twin(kind, sessions, folder, rate_hz=100.0):
    """An unfitted twin of the lever and its speed."""
    channels = TwinChannels((Channel("lever", Kind.GENERIC),), (Channel("speed", Kind.VELOCITY),), (), (), rate_hz)
    series = [channels.task().series(dataclasses.replace(one, rate_hz=rate_hz)) for one in sessions.read()]
    twin = kind.start(channels, fit_scales(channels, series), series, 0)
    save_twin(TwinBundle(kind, twin), folder)
    return str(folder)


def test_a_grey_box_that_follows_the_machine_moves_what_is_replayed(adapted, lever_sessions, tmp_path, monkeypatch):
    folder, command = str(adapted[0]), CliRunner()
    monkeypatch.setattr("edp.networks.twin.adaptive_correction.JUDGED_S", 0.5)  # the logs take three seconds
    twin = saved_twin(GreyBox(), lever_sessions, tmp_path / "grey")
    plain, moved = (
        json.loads(
            command.invoke(
                app, ["adapt", "replay", folder, str(lever_sessions.path), "--carry", *more, "--json"]
            ).stdout
        )["mae"]
        for more in ((), ("--twin", twin))
    )
    assert [row["base"] for row in moved] == [row["base"] for row in plain]
    assert [row["adapted"] for row in moved] != [row["adapted"] for row in plain]
    slow = saved_twin(GreyBox(), lever_sessions, tmp_path / "slow", 50.0)
    with pytest.raises(ConfigError, match="the twin has 50 Hz, the network 100 Hz"):
        replay_run(folder, lever_sessions, twin=slow)
    static = saved_twin(TWINS["static"](), lever_sessions, tmp_path / "static")
    with pytest.raises(ConfigError, match="only a grey box"):
        replay_run(folder, lever_sessions, twin=static)


def test_a_thermometer_in_the_logs_of_twin_and_replay_moves_its_numbers(adapted, lever_sessions, tmp_path):
    bundle = load_bundle(adapted[0])
    grey = load_twin(saved_twin(GreyBox(), lever_sessions, tmp_path / "grey"))
    assert math.isnan(choose_tuned_spec(grey).oil_c)
    spec = choose_tuned_spec(dataclasses.replace(grey, provenance=Provenance(more={"oil_c": 20.0})))
    moves, recordings = (
        TwinMoves(grey.twin, correction_of(grey.twin, bundle.adaptation, bundle.task, spec)),
        lever_sessions.read(),
    )
    cold = recordings[0]
    warm = with_channel(cold, Channel("OilTemperature", Kind.TEMPERATURE), 273.15 + 60.0)
    other = with_channel(cold, Channel("OilTemperature", Kind.GENERIC), 333.15)
    zeros = np.zeros((cold.samples, len(bundle.adaptation.horizons), len(bundle.task.targets)), np.float32)
    for recording, viscosity in ((cold, 1.0), (other, 1.0), (warm, math.exp(-1.4))):
        moves([recording], [zeros], carry=False, learn=False)
        assert moves.correction.tuned.factors["oil"] == pytest.approx(viscosity)
    for wrong in (True, "hot", 4000.0, [20.0]):
        with pytest.raises(BundleError, match="no temperature of oil"):
            choose_tuned_spec(dataclasses.replace(grey, provenance=Provenance(more={"oil_c": wrong})))


def with_channel(recording, channel, value):
    values = np.column_stack([recording.values, np.full(recording.samples, value, np.float32)])
    return dataclasses.replace(recording, channels=(*recording.channels, channel), values=values)


def test_a_grey_box_that_follows_leaves_as_c(run, adapted, lever_sessions, tmp_path):
    twin, out, command = saved_twin(GreyBox(), lever_sessions, tmp_path / "grey"), tmp_path / "out", CliRunner()
    given = ["export", str(adapted[0]), "--to", "follower", "--out", str(out)]
    done = command.invoke(app, [*given, "--twin", twin, "--set", "learn_ticks=10", "--set", "oil_c=20"])
    assert done.exit_code == 0, done.output
    assert "read follower.h first" in done.output
    assert "at most 10" not in (out / "follower.h").read_text()
    assert "learning 10." in (out / "follower.h").read_text()
    for wrong, said in (
        ((), "needs --twin GREY"),
        (("--twin", twin, "--set", "groups=gain"), "no such option"),
        (("--twin", twin, "--set", "gain=x"), "a number must hold"),
        (("--twin", twin, "--set", "learn_ticks=1"), "learn_ticks"),
        (("--twin", twin, "--name", "../x"), "prefix of C functions"),
    ):
        assert said in str(command.invoke(app, [*given, *wrong]).exception)
    plain = command.invoke(app, ["export", str(run), "--to", "follower", "--twin", twin, "--out", str(out)])
    assert "edp adapt" in str(plain.exception)
    alone = command.invoke(app, ["export", str(run), "--to", "c", "--twin", twin, "--out", str(out)])
    assert "'c' reads no grey box beside the run, follower does" in str(alone.exception)


def test_what_cannot_be_is_refused_before_anything_is_written(run, adapted, lever_sessions, tmp_path):
    with pytest.raises(StorageError, match="nothing was changed"):
        adapt(run, run, SPEC)
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match="only 1 inputs"):
        adapt(run, out, AdaptationSpec(rank=2))
    assert not out.exists()
    bundle, _, _, data = read_trained_run(run)
    blind = dataclasses.replace(data.task, targets=("other",), mode="absolute")
    with pytest.raises(ConfigError, match="other is predicted, but not measured"):
        fit_adaptation(bundle.predictor, dataclasses.replace(data, task=blind), SPEC)
    done = CliRunner().invoke(app, ["adapt", "replay", str(run), str(lever_sessions.path)])
    assert isinstance(done.exception, BundleError)
    assert "edp adapt" in str(done.exception)
