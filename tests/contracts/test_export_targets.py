"""Every export target, also one that is entered tomorrow: it writes each network, or refuses it with the reason."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edp.config.experiment import load_experiment
from edp.data.scaling import Scaler
from edp.export import TARGETS
from edp.networks import build_model
from edp.networks.narrow import student
from edp.testing.targets import bundle_around, check_names_refused, check_written, refusal_of

THESIS = sorted((Path(__file__).parents[2] / "examples" / "thesis").glob("*.toml"))
WINNERS = ("k10_teacher", "k1_teacher_p4", "k1_teacher_p5", "table_b1")
QUICK = {"fmu": {"binaries": "none"}}
"""Options without which a target compiles for minutes."""
KINDS = ("hybrid+all", "hybrid9", "tcn+all", "gru+quantiles", "lstm2", "lstm+hybrid physics")
"""Among them all kinds of layers."""


def thesis_network(path, units=None):
    experiment = load_experiment(path)
    task = experiment.task.resolve(100.0, physics=experiment.model.physics)
    model = experiment.model if units is None else student(experiment.model, units)
    features, blank = len(task.features.features), np.zeros((len(task.horizons), len(task.targets)))
    return build_model(task, model, Scaler(np.zeros(features), np.ones(features), blank, blank + 1), seed=0).eval()


@pytest.mark.parametrize("target", list(TARGETS))
@pytest.mark.parametrize("settings", [path for path in THESIS if path.stem in WINNERS], ids=lambda path: path.stem)
def test_the_networks_of_the_thesis_narrowed_are_written_in_every_form(settings, target, tmp_path):
    check_written(target, bundle_around(thesis_network(settings, units=8)), tmp_path / "made", QUICK.get(target))


@pytest.mark.slow
@pytest.mark.parametrize("target", list(TARGETS))
@pytest.mark.parametrize("settings", THESIS, ids=lambda path: path.stem)
def test_the_networks_of_the_thesis_are_written_in_every_form(settings, target, tmp_path):
    check_written(target, bundle_around(thesis_network(settings)), tmp_path / "made", QUICK.get(target))


def refusal(target, predictor, folder):
    """Empty where the network was written; a refusal leaves nothing behind."""
    return refusal_of(target, bundle_around(predictor), folder, QUICK.get(target))


@pytest.mark.parametrize("target", list(TARGETS))
@pytest.mark.parametrize("network", KINDS)
def test_every_kind_of_layer_is_written_in_single_precision(network, target, predictor_of, tmp_path):
    assert refusal(target, predictor_of(network, dtype=torch.float32), tmp_path / "made") == ""


@pytest.mark.parametrize("target", list(TARGETS))
def test_whole_numbers_are_written_or_refused(target, integers_of, tmp_path):
    reason = refusal(target, integers_of("hybrid+temporal_difference"), tmp_path / "made")
    assert not reason or "w8a16" in reason


@pytest.mark.slow
@pytest.mark.parametrize("target", list(TARGETS))
def test_every_network_is_written_or_refused(structure, target, predictor_of, tmp_path):
    refusal(target, predictor_of(structure, dtype=torch.float32), tmp_path / "made")


@pytest.mark.parametrize("target", list(TARGETS))
def test_names_that_cannot_be_are_refused(target, predictor_of, tmp_path):
    bundle = bundle_around(predictor_of("lstm", dtype=torch.float32))
    check_names_refused(target, bundle, tmp_path / "made", QUICK.get(target))
