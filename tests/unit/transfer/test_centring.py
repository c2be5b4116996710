"""Centring: what it takes out, what it leaves alone, and where it does nothing."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.networks.activations import ACTIVATIONS
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import build_model
from edp.networks.running import stream_intervals, stream_predictions
from edp.training import load_bundle
from edp.training.bundle import blank_scaler
from edp.training.transfer import centring
from edp.training.transfer.centring import DEAREST, centre
from edp.workflows.transfer import FinetuneRequest, finetune
from edp.workflows.transfer.source import read_source

pytestmark = pytest.mark.processes


def errors(net, series):
    """Errors after a whole window, one array a horizon, computed apart from the code that is tested."""
    skip, found = net.spec.window, []
    said = stream_predictions(net, series)
    for place, k in enumerate(net.task.horizons):
        each = [s[skip : len(s) - k, place] - p.targets[skip + k :] for s, p in zip(said, series, strict=True)]
        found.append(np.concatenate(each).astype(np.float64))
    return found


def learned(source, **changes):
    """The source's network with other parts, its weights where they fit."""
    spec = replace(source.spec, **changes)
    net = build_model(source.task, spec, blank_scaler(source.task), 0)
    known = {k: v for k, v in source.state_dict().items() if net.state_dict()[k].shape == v.shape}
    net.load_state_dict(known, strict=False)
    return net.eval()


@pytest.fixture(scope="module")
def domain(run, target):
    source = read_source(run)
    return source.predictor, [source.bundle.task.series(recording) for recording in target.read()]


@pytest.mark.parametrize("kind", ["plain", "stanh", "quantiles"])
def test_the_mean_error_goes_and_little_else_changes(domain, kind):
    source, series = domain
    parts = {"stanh": {"activation": ACTIVATIONS["stanh"]()}, "quantiles": {"output": OUTPUTS["quantiles"]()}}
    net = learned(source, **parts.get(kind, {}))
    last = net.heads.biases[-1]
    values = net.spec.output.values
    with torch.no_grad():
        last[:, ::values] += 1.0
    before = copy.deepcopy(net.state_dict())
    offset = errors(net, series)
    bounds = stream_intervals(net, series) if kind == "quantiles" else None
    centre(net, series)
    for found, was in zip(errors(net, series), offset, strict=True):
        assert (np.abs(was.mean(axis=0)) > 0.2 * np.abs(was).mean(axis=0)).all()
        if kind == "stanh":  # bounded heads cannot say just anything
            assert (np.abs(found.mean(axis=0)) < np.abs(was.mean(axis=0))).all()
        else:
            assert (np.abs(found.mean(axis=0)) <= 0.01 * np.abs(found).mean(axis=0)).all()
        assert (np.abs(found).mean(axis=0) <= DEAREST * np.abs(was).mean(axis=0)).all()
    changed = [name for name, value in net.state_dict().items() if not torch.equal(value, before[name])]
    assert changed == [f"heads.biases.{len(net.heads.biases) - 1}"]
    if bounds is not None:  # an interval moves with the prediction, as wide as it was
        for wide, was in zip(stream_intervals(net, series), bounds, strict=True):
            np.testing.assert_allclose(wide[:, :, 1] - wide[:, :, 0], was[:, :, 1] - was[:, :, 0], atol=1e-5)


def test_nothing_is_done_without_a_whole_window_or_at_too_high_a_price(domain):
    source, series = domain
    net = learned(source)
    before = copy.deepcopy(net.state_dict())
    centre(net, [replace(part, inputs=part.inputs[:8], targets=part.targets[:8]) for part in series])
    centre(net, [])
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    # One tick in fifty is off by much: its mean is far from the median, and the median is what errors are least at.
    said = stream_predictions(net, series)
    rare = []
    for values, part in zip(said, series, strict=True):
        truth = part.targets.copy()
        for k in net.task.horizons[::-1]:
            truth[k:] = values[:-k, net.task.horizons.index(k)]
        truth[::50] += 50.0
        rare.append(replace(part, targets=truth))
    centre(net, rare)
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_a_fine_tuned_network_is_centred_unless_it_is_not_asked_for_or_logs_are_short(
    run, target, small, tmp_path, monkeypatch
):
    last = {}
    for name, center, shortest in (("yes", True, 1.0), ("no", False, 1.0), ("short", True, 1e3)):
        monkeypatch.setattr(centring, "SHORTEST_S", shortest)
        folder = tmp_path / name
        order = FinetuneRequest(
            spec=replace(small, center=center), method="full", baselines=(), changes=("training.updates=25",)
        )
        finetune(run, target, order, folder)
        net = load_bundle(folder / "bundle").predictor
        last[name] = net.heads.biases[-1].detach().clone()
    assert not torch.equal(last["yes"], last["no"])
    assert torch.equal(last["short"], last["no"])
