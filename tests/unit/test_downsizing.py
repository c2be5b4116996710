"""Smaller networks of runs on disk: students, and that they go on after a stop to the same bits."""

import dataclasses
import json

import pytest
import torch
from noted_progress import NotedProgress
from typer.testing import CliRunner

from edp.cli import app
from edp.config.experiment import load_experiment
from edp.errors import ConfigError, EdpError, StorageError
from edp.storage import read_json
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.workflows.compression import DistillationSpec, DistilRequest, DistilSpec, distil
from edp.workflows.compression.distil import read_run
from edp.workflows.train_evaluate import DataSource, evaluate, train

pytestmark = pytest.mark.long

SETTINGS = (
    'task.features={name="levers", channels=["speed", "lever"]}',
    'task.targets=["speed"]',
    "task.horizons=[2]",
    "training.epochs=2",
    "training.updates=4",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[8,8],kernel=2,units=8}',
    "model.head.hidden=8",
    "model.blocks=[]",
    "model.window=10",
    "evaluation.history=4",
    'evaluation.baselines=["persistence"]',
)


@pytest.fixture(scope="module")
def run(lever_sessions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "run"
    train(lever_sessions, load_experiment(preset="quick", overrides=SETTINGS), folder)
    return folder


class Pulled(Exception):
    pass


def pull(done, **values):
    if "validation_mae" in values:
        raise Pulled


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.predictor.parameters(), other.predictor.parameters(), strict=True))


def test_a_student_is_a_run_that_goes_on_after_a_stop(run, tmp_path):
    spec = DistilRequest(spec=DistilSpec(units=4))
    whole = distil(run, spec, tmp_path / "whole")
    with pytest.raises(Pulled):
        distil(run, spec, tmp_path / "stopped", progress=NotedProgress(pull))
    assert same(distil(run, spec, tmp_path / "stopped"), whole)
    assert whole.predictor.spec.backbone.units == 4
    assert whole.predictor.spec.backbone.channels == (4,)
    provenance = read_json(tmp_path / "whole" / "provenance.json")
    assert provenance["strategy"]["teachers"] == [weights_digest(load_bundle(run).predictor)]
    scores = read_json(evaluate(tmp_path / "whole") / "scores.json")
    assert set(scores["models"]) == {"network", "persistence"}


def test_another_lesson_is_another_run(run, tmp_path):
    distil(run, DistilRequest(spec=DistilSpec(units=4)), tmp_path / "run")
    with pytest.raises(StorageError, match="holds another run"):
        distil(
            run,
            DistilRequest(spec=DistilSpec(units=4, objective=DistillationSpec(target_weight=0.2))),
            tmp_path / "run",
        )


def test_pruned_starts_further_recordings_and_teachers_take_part(run, lever_sessions, tmp_path):
    plain = distil(run, DistilRequest(spec=DistilSpec(units=4, levels=2)), tmp_path / "plain")
    pruned = distil(run, DistilRequest(spec=DistilSpec(units=4, pruned=True)), tmp_path / "pruned")
    assert pruned.predictor.spec == plain.predictor.spec
    assert not same(pruned, plain)
    spec = DistilRequest(
        spec=DistilSpec(units=4, levels=2), teachers=(str(tmp_path / "plain"),), further=lever_sessions
    )
    taught = distil(run / "bundle", spec, tmp_path / "taught")
    assert len(taught.provenance.more["strategy"]["teachers"]) == 2
    assert len(taught.provenance.more["strategy"]["further"]) == 5


def test_a_pruned_student_has_no_levels_of_its_own():
    with pytest.raises(ConfigError, match="leave out the levels"):
        DistilSpec(units=4, levels=1, pruned=True)


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (DistilRequest(spec=DistilSpec(units=9)), "units = 9; 1 <= units <= 8"),
        (DistilRequest(spec=DistilSpec(units=8, levels=2)), "is the teacher itself"),
        (DistilRequest(spec=DistilSpec(units=4, levels=3)), "levels = 3"),
        (DistilRequest(spec=DistilSpec(units=4), changes=("model.window=20",)), "those of its teacher"),
        (DistilRequest(spec=DistilSpec(units=4), changes=("training.epoch=20",)), "training.epoch"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(run, tmp_path, spec, reason):
    with pytest.raises(ConfigError, match=reason):
        distil(run, spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_bundle_without_its_run_is_refused(run, tmp_path):
    (run / "bundle").rename(tmp_path / "alone")
    try:
        with pytest.raises(StorageError, match="not a run folder"):
            read_run(tmp_path / "alone")
        with pytest.raises(EdpError):
            read_run(tmp_path)
    finally:
        (tmp_path / "alone").rename(run / "bundle")


def test_other_recordings_can_be_learned_on(run, lever_sessions, tmp_path):
    source = DataSource.from_path(lever_sessions.path)
    bundle = distil(
        run, DistilRequest(spec=DistilSpec(units=4), changes=("training.epochs=1",)), tmp_path / "other", source
    )
    assert dataclasses.is_dataclass(bundle)
    assert bundle.provenance.origin.source == str(lever_sessions.path)


def test_the_command_makes_a_run_and_says_what_it_is(run, tmp_path):
    told = CliRunner().invoke(
        app, ["compress", "distil", str(run), "--units", "4", "--out", str(tmp_path / "small"), "--json"]
    )
    assert told.exit_code == 0, told.output
    facts = json.loads(told.stdout)
    assert facts["student"]["parameters"] < facts["teacher"]["parameters"]
    assert load_bundle(tmp_path / "small").predictor.spec.backbone.units == 4
    shown = CliRunner().invoke(app, ["compress", "distil", str(run), "--units", "4", "--out", str(tmp_path / "small")])
    assert "next: edp evaluate" in shown.output
