"""Every registered derivation: a stream of any chunks and the layer list give what its equation gives."""

import numpy as np
import pytest
import torch

from edp.config.experiment import build
from edp.data.features import DERIVATIONS, MAX_LAG, Derived, FeatureSet, derive
from edp.data.scaling import feature_matrix
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec, TcnSpec
from edp.networks.heads import LinearHead, MlpHead
from edp.networks.plain import task_from_dict, task_to_dict
from edp.networks.predictor import ModelSpec
from edp.testing.networks import small_network
from edp.testing.streaming import check_network

RATE = 100.0
SPANS = (0.02, 0.03, 0.07)


def entries(names=tuple(DERIVATIONS)):
    """Each derivation of two channels, with several spans where it takes one."""
    derived = []
    for how in names:
        for span in SPANS if DERIVATIONS[how].least_ticks else (None,):
            for source in ("a", "load"):
                derived.append(Derived(f"{how} of {source} {span}", source, how, span_s=span))
    return tuple(derived)


def task_of(derived):
    return Task(FeatureSet("all", ("a", "b"), derived, hidden=("load",)), ("a",), (1, 3), TargetMode.DELTA, RATE)


def equation(entry, x):
    """The derived channel tick by tick, as its docstring says."""
    kind, n = DERIVATIONS[entry.how], entry.ticks(RATE)
    steps = np.diff(x, prepend=x[:1]) if kind.of_changes else x
    means = [steps[max(0, t + 1 - n) : t + 1].mean() for t in range(len(x))]
    return np.array(means) * kind.gain(n, RATE)


@pytest.mark.parametrize("entry", entries(), ids=lambda entry: entry.name)
def test_a_whole_stretch_has_the_values_of_the_equation(entry):
    x = np.random.default_rng(0).normal(3e7, 1e5, size=60)
    expected = equation(entry, x.astype(np.float32).astype(np.float64))
    np.testing.assert_allclose(derive(entry, x.astype(np.float32), RATE), expected, rtol=1e-6, atol=1e-3)


def test_behind_its_span_a_change_is_a_difference_and_a_mean_forgets():
    x = np.arange(40, dtype=np.float32) ** 2
    change = derive(Derived("c", "x", "change", span_s=0.05), x, RATE)
    np.testing.assert_allclose(change[5:], x[5:] - x[:-5], rtol=1e-6)
    mean = derive(Derived("m", "x", "trailing_mean", span_s=0.05), np.where(np.arange(40) < 20, 7e6, x), RATE)
    np.testing.assert_allclose(mean[24:], [x[t - 4 : t + 1].mean() for t in range(24, 40)], rtol=1e-6)


@pytest.mark.parametrize("how", DERIVATIONS)
@pytest.mark.parametrize("cuts", [(1,) * 24, (5, 1, 18), (24,)], ids=str)
def test_a_stream_gives_what_a_stretch_has(how, cuts):
    task = task_of(entries((how,)))
    network = small_network(ModelSpec(backbone=TcnSpec(channels=(4,), kernel=9), blocks=(), window=9), task)
    values = np.random.default_rng(1).normal(size=(24, 3)).astype(np.float32)
    x = torch.from_numpy(values)[None]
    state, pieces = network.front.initial_state(1, x), []
    for piece in torch.split(x, list(cuts), dim=1):
        features, state = network.front(piece, state)
        pieces.append(features)
    expected = feature_matrix(task, Series("s", values, values[:, :1]))
    np.testing.assert_allclose(torch.cat(pieces, 1)[0].numpy(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "model",
    [
        ModelSpec(backbone=TcnSpec(channels=(4,), kernel=9), head=MlpHead(hidden=4), blocks=(), window=9),
        ModelSpec(backbone=CommitteeSpec(lags=(1, 3), members=2, units=4), head=LinearHead(), blocks=(), window=9),
    ],
    ids=["tcn", "committee"],
)
def test_a_network_behind_all_derivations_keeps_every_contract(model):
    check_network(small_network(model, task_of(entries())))


@pytest.mark.long
def test_entries_stay_in_their_order():
    mixed = tuple(entries()[number] for number in np.random.default_rng(0).permutation(len(entries())))
    network = small_network(ModelSpec(backbone=TcnSpec(channels=(4,), kernel=9), blocks=(), window=9), task_of(mixed))
    check_network(network)


def test_a_task_with_spans_survives_the_header_of_a_bundle():
    task = task_of(entries())
    assert task_from_dict(task_to_dict(task)) == task


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"how": "change"}, "looks back over a span.*span_s = 0.1"),
        ({"how": "difference", "span_s": 0.1}, "has no span.*'change' or 'trailing_mean'"),
        ({"how": "change", "span_s": 0.0}, "span_s"),
        ({"how": "change", "span_s": float("nan")}, "span_s"),
        ({"how": "change", "span_s": 0.004}, r"0\.4 ticks at 100 Hz; from 1 to 4096"),
        ({"how": "trailing_mean", "span_s": 0.01}, "from 2 to 4096 ticks"),
        ({"how": "change", "span_s": 41.0}, "4100 ticks.*choose from 0.01 to 40.96 s"),
    ],
)
def test_spans_that_cannot_be_are_one_error(options, message):
    with pytest.raises(ConfigError, match=message):
        task_of((Derived("d", "a", **options),))


def test_spans_are_read_from_settings_and_rounded_to_ticks():
    derived = build(Derived, {"name": "d", "source": "a", "how": "change", "seconds": 0.03}, "test")
    assert (derived.ticks(100.0), derived.ticks(50.0), derived.gain(1000.0)) == (3, 2, 30.0)
    assert Derived("d", "a", "change", span_s=MAX_LAG / RATE).ticks(RATE) == MAX_LAG
