"""A training in parts gives what the same training without a stop gives, to the bit."""

import dataclasses

import pytest
import torch

from edp.data.augment import AUGMENTATIONS
from edp.data.chunks import ChunkSpec
from edp.errors import ConfigError
from edp.networks.backbones import LstmSpec
from edp.networks.losses import AdaptiveWeights
from edp.training.averages import Stochastic
from edp.training.fit import fit
from edp.training.optimizers import OPTIMIZERS
from edp.training.parts import fit_part

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def one_epoch(tiny_training):
    return dataclasses.replace(tiny_training, epochs=1, updates=40, patience=0, refit="none")


def in_parts(data, model, spec, stops):
    """The end of a training that was stopped at each of some updates, and what was judged there."""
    state, judged = None, []
    for stop in stops:
        torch.manual_seed(99)  # another process would have drawn other things meanwhile
        fitted, state = fit_part(data, model, spec, stop, state)
        judged.append(fitted)
    torch.manual_seed(98)
    fitted, nothing = fit_part(data, model, spec, None, state)
    assert nothing is None
    return fitted, judged


def assert_same(one, other):
    for (name, mine), theirs in zip(one.predictor.named_parameters(), other.predictor.parameters(), strict=True):
        assert torch.equal(mine, theirs), name
    rows = [{key: value for key, value in fitted.history[-1].items() if key != "seconds"} for fitted in (one, other)]
    assert rows[0] == rows[1]


@pytest.mark.parametrize("stops", [(1,), (5, 10, 20), (39,)])
def test_parts_give_the_bits_of_the_whole(stops, tiny, tiny_model, one_epoch):
    whole = fit(tiny, tiny_model, one_epoch)
    fitted, judged = in_parts(tiny, tiny_model, one_epoch, stops)
    assert_same(fitted, whole)
    assert [part.history[-1]["updates"] for part in judged] == list(stops)


@pytest.mark.parametrize("optimizer", list(OPTIMIZERS))
def test_every_optimizer_goes_on_with_what_else_has_a_memory(optimizer, tiny, tiny_bypass, one_epoch):
    spec = dataclasses.replace(
        one_epoch,
        optimizer=OPTIMIZERS[optimizer](),
        average=Stochastic(fraction=0.5),
        adaptive=AdaptiveWeights(blend=0.5),
        augmentations=tuple(kind() for kind in AUGMENTATIONS.values()),
    )
    assert_same(in_parts(tiny, tiny_bypass, spec, (7, 31))[0], fit(tiny, tiny_bypass, spec))


def test_windows_and_dropped_cells_go_on_too(tiny, tiny_model, one_epoch):
    spec = dataclasses.replace(one_epoch, chunks=ChunkSpec(regime="window", length=10, batch=8, burn_in=0))
    model = dataclasses.replace(tiny_model, backbone=LstmSpec(units=8, layers=2, dropout=0.2, zoneout=0.2))
    assert_same(in_parts(tiny, model, spec, (13,))[0], fit(tiny, model, spec))


def test_equal_parts_leave_equal_bytes_however_they_came_there(tiny, tiny_model, one_epoch):
    _, first = fit_part(tiny, tiny_model, one_epoch, 10)
    _, straight = fit_part(tiny, tiny_model, one_epoch, 20)
    _, over_a_stop = fit_part(tiny, tiny_model, one_epoch, 20, first)
    assert straight == over_a_stop
    assert first != straight


def test_a_part_is_what_a_training_of_constant_rate_that_ends_there_gives(tiny, tiny_model, one_epoch):
    spec = dataclasses.replace(one_epoch, schedule=type(one_epoch.schedule)())
    part, _ = fit_part(tiny, tiny_model, spec, 10)
    assert part.history[-1]["validation_mae"] > 0
    assert not part.predictor.training


def test_parts_that_cannot_be_are_refused(tiny, tiny_model, one_epoch):
    _, state = fit_part(tiny, tiny_model, one_epoch, 10)
    for until in (0, 40, 41):
        with pytest.raises(ConfigError, match=f"from update 0 to {until} of 40"):
            fit_part(tiny, tiny_model, one_epoch, until)
    with pytest.raises(ConfigError, match="from update 10 to 10 of 40"):
        fit_part(tiny, tiny_model, one_epoch, 10, state)
    with pytest.raises(ConfigError, match="cannot be done in parts"):
        fit_part(tiny, tiny_model, dataclasses.replace(one_epoch, refit="best"), 10)
    several = dataclasses.replace(one_epoch, epochs=3)
    _, state = fit_part(tiny, tiny_model, several, 1)
    for until in (0, 3, 4):
        with pytest.raises(ConfigError, match=f"from epoch 0 to {until} of 3"):
            fit_part(tiny, tiny_model, several, until)
    with pytest.raises(ConfigError, match="from epoch 1 to 1 of 3"):
        fit_part(tiny, tiny_model, several, 1, state)
