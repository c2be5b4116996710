"""How far another form may be from PyTorch where rounding decides at the thresholds of trees."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from edp.export.golden import TRIES, golden_recording, random_inputs, relax_at_thresholds, stream, tolerance
from edp.workflows.parity.compare import golden_case

TICKS, MET = 60, 40


@pytest.fixture
def met(bundle_of):
    """A committee one of whose numbers is exactly a threshold at one tick of `random_inputs` with seed 0."""
    predictor = copy.deepcopy(bundle_of("committee").predictor)
    inputs = random_inputs(predictor, TICKS, seed=0)
    x = torch.from_numpy(inputs)[None]
    with torch.no_grad():
        features, _ = predictor.front(x, predictor.front.initial_state(1, x))
        bank = predictor.backbone.bank
        columns, _ = bank(predictor.front.scale(features), bank.initial_state(1, x))
    trees = predictor.backbone.trees
    # The root of a tree that is read: the head gives each output a weight for it.
    trees.threshold[0, 0, 0] = columns[0, MET, trees.feature[0, 0, 0]]
    return predictor, inputs


def test_only_ticks_at_a_threshold_are_allowed_a_step(met):
    predictor, inputs = met
    steps = relax_at_thresholds(predictor, inputs)
    assert steps.shape == (TICKS, len(stream(predictor, inputs)[0]))
    assert steps[MET].max() > 0.0
    assert np.count_nonzero(steps.max(axis=1)) == 1
    moved = copy.deepcopy(predictor)
    moved.backbone.trees.threshold[0, 0, 0] -= 1e-7 * max(1.0, abs(float(moved.backbone.trees.threshold[0, 0, 0])))
    apart = np.abs(stream(moved, inputs) - stream(predictor, inputs))
    allowed = tolerance(predictor, inputs, stream(predictor, inputs))
    # What one rounding did is a step, far beyond the tolerance of all other ticks.
    assert (apart[MET] > 10 * allowed).any()
    assert (apart <= allowed + steps).all()


def test_what_is_allowed_elsewhere_does_not_grow(met, bundle_of):
    predictor, inputs = met
    outputs = stream(predictor, inputs)
    plain = bundle_of("committee").predictor
    wanted = tolerance(plain, inputs, stream(plain, inputs))
    np.testing.assert_allclose(tolerance(predictor, inputs, outputs), wanted, rtol=0.2)


def test_a_recording_without_such_a_tick_is_drawn(met):
    predictor, inputs = met
    drawn, outputs, allowed = golden_recording(predictor, TICKS)
    assert not np.array_equal(drawn, inputs)
    np.testing.assert_array_equal(outputs, stream(predictor, drawn))
    np.testing.assert_array_equal(allowed, tolerance(predictor, drawn, outputs))


def test_where_every_recording_has_one_the_step_is_allowed(met):
    predictor, _ = met
    trees = predictor.backbone.trees
    # At a tick after a reset every change is zero: a threshold there is met by all recordings.
    trees.feature[0, 0, 0], trees.threshold[0, 0, 0] = trees.width - 1, 0.0
    drawn, outputs, allowed = golden_recording(predictor, TICKS)
    np.testing.assert_array_equal(drawn, random_inputs(predictor, TICKS, seed=_least(predictor)))
    assert (allowed > 10 * tolerance(predictor, drawn, outputs)).any()


def _least(predictor):
    """The draw whose largest step is the smallest, the first one of equals."""
    steps = [relax_at_thresholds(predictor, random_inputs(predictor, TICKS, seed), 1e-6).max() for seed in range(TRIES)]
    return int(np.argmin(steps))


@pytest.mark.parametrize("network", ["hybrid", "committee1"])
def test_networks_without_trees_have_one_tolerance_for_all_ticks(network, bundle_of):
    bundle = bundle_of(network)
    inputs = random_inputs(bundle.predictor, TICKS, seed=0)
    assert not relax_at_thresholds(bundle.predictor, inputs).any()
    np.testing.assert_array_equal(golden_recording(bundle.predictor, TICKS)[0], inputs)
    assert golden_case(bundle, TICKS, 0).allowed.ndim == 1
