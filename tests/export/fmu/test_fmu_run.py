"""FMUs of both versions against PyTorch through FMPy, and their rules at run time."""

from __future__ import annotations

import copy
import ctypes
import re

import numpy as np
import pytest
import torch

from edp.export.c.model import HOLD_TICKS
from edp.export.golden import random_inputs
from edp.networks.input_range import usual_range

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install 'excavator-dynamics-predictor[fmu]'")
from fmpy.fmi1 import FMICallException  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

both = pytest.mark.parametrize("version", [2, 3])


@both
@pytest.mark.parametrize("network", ["hybrid+all", "tcn+quantiles", "lstm+hybrid physics"])
def test_an_fmu_predicts_what_pytorch_predicts(network, version, unit, bundle_of, fmi):
    fmi.held(unit(network, version), bundle_of(network), 300)


@both
def test_whole_numbers_give_the_bits_of_the_reference(version, unit, bundle_of, fmi):
    fmi.held(unit("hybrid", version, whole=True), bundle_of("hybrid", True), 200)


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_every_network_has_its_fmus(structure, whole, written, unit, bundle_of, fmi):
    bundle = bundle_of(structure, whole)
    for version in (2, 3):
        assert validate_fmu(str(written(structure, version, whole))) == []
        fmi.held(unit(structure, version, whole), bundle, 300)


@both
def test_without_inputs_there_is_no_prediction(version, unpacked):
    """A simulation with nothing connected runs, says what is missing, and never calls a prediction valid."""
    found = fmpy.simulate_fmu(str(unpacked("lstm", version)), output=["status", "valid"])
    assert len(found) == 501
    assert set(found["status"]) == {3}
    assert not found["valid"].any()


@both
def test_another_step_is_refused(version, unit, bundle_of):
    made, rows = unit("lstm", version).start(), random_inputs(bundle_of("lstm").predictor, 4, 0)
    before = made.stream(rows[:2])[-1]
    for at, size, words in (
        (None, 2 * made.step_s, "set the communication step size"),
        (None, 0.99 * made.step_s, "set the communication step size"),
        (None, np.nan, "set the communication step size"),
        (made.step_s, None, "to go back restore a state"),
        (2.5 * made.step_s, None, "to go back restore a state"),
        (np.nan, None, "to go back restore a state"),
    ):
        with pytest.raises(FMICallException):
            made.go(at, size)
        assert made.told[-1][0] == 3
        assert words in made.told[-1][1]
    np.testing.assert_array_equal(made.get(made.outputs), before)  # nothing has changed
    made.set(rows[2])
    assert made.go(2 * made.step_s) == 0


@both
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, 3e38])
def test_bad_inputs_are_held_and_told(version, bad, unit, bundle_of):
    predictor = bundle_of("lstm").predictor
    made, rows = unit("lstm", version).start(), random_inputs(predictor, 60, 0)
    good = made.stream(rows[:20])[-1]
    for tick in range(HOLD_TICKS):
        made.set([bad], made.inputs[:1])
        assert made.go() == 1
        assert (made.whole("status"), made.whole("held"), made.valid) == (2, tick + 1, False)
    held = made.get(made.outputs)
    assert np.isfinite(held).all()
    assert not np.array_equal(held, good)
    assert len(made.told) == 1  # the first of them
    assert "last accepted inputs were used" in made.told[0][1]
    assert made.go() == 1
    assert (made.whole("status"), made.whole("restarts")) == (3, 1)
    np.testing.assert_array_equal(made.get(made.outputs), held)
    assert "no prediction" in made.told[-1][1]
    fresh = unit("lstm", version).start()
    np.testing.assert_array_equal(made.stream(rows[20:]), fresh.stream(rows[20:]))


@both
def test_a_missing_channel_is_named(version, unit, bundle_of):
    made, bundle = unit("lstm", version).start(), bundle_of("lstm")
    made.set(random_inputs(bundle.predictor, 1, 0)[0][:-1], made.inputs[:-1])
    assert made.go() == 1
    assert f"input '{bundle.inputs[-1].name}' was never set" in made.told[-1][1]
    assert made.whole("status") == 3


@both
def test_missed_ticks_are_held(version, unit, bundle_of):
    made, rows = unit("lstm", version).start(), random_inputs(bundle_of("lstm").predictor, 30, 0)
    made.stream(rows[:20])
    made.tick += 2
    made.set(rows[22])
    assert made.go() == 1
    assert "2 ticks were left out" in made.told[-1][1]
    other = unit("lstm", version).start()
    found = other.stream(rows[[*range(20), 19, 19, 22]])
    np.testing.assert_array_equal(made.get(made.outputs).astype(np.float32), found[-1])
    made.tick += HOLD_TICKS + 3
    made.set(rows[25])
    assert made.go() == 1
    assert (made.whole("status"), made.whole("restarts")) == (1, 1)  # anew


@both
def test_instances_share_nothing_and_reset_starts_anew(version, unit, bundle_of):
    predictor = bundle_of("hybrid+all").predictor
    rows = random_inputs(predictor, 40, 0)
    alone = unit("hybrid+all", version).start().stream(rows)
    one, two = unit("hybrid+all", version).start(), unit("hybrid+all", version).start(at=1.0)
    found = []
    for row, other in zip(rows, rows[::-1]):
        found.append(one.stream(row[None])[0])
        two.stream(other[None])
    np.testing.assert_array_equal(found, alone)
    one.fmu.reset()
    with pytest.raises(FMICallException):
        one.go(0.0)
    assert "initialised" in one.told[-1][1]
    np.testing.assert_array_equal(one.start().stream(rows), alone)
    one.fmu.terminate()
    with pytest.raises(FMICallException):
        one.go()


@both
def test_states_roll_back_to_the_same_bits(version, unit, bundle_of):
    rows = random_inputs(bundle_of("hybrid+all").predictor, 60, 0)
    made = unit("hybrid+all", version).start()
    made.stream(rows[:23])
    state = made.fmu.getFMUState()
    kept = made.fmu.serializeFMUState(state)
    wanted = made.stream(rows[23:])
    made.fmu.setFMUState(state)
    made.tick = 23
    np.testing.assert_array_equal(made.stream(rows[23:]), wanted)
    made.fmu.freeFMUState(state)
    other = unit("hybrid+all", version)  # in another process it would be the same
    read = other.fmu.deSerializeFMUstate if version == 2 else other.fmu.deserializeFMUState
    again = read(kept)
    assert other.fmu.serializeFMUState(again) == kept
    other.fmu.setFMUState(again)
    other.tick = 23
    np.testing.assert_array_equal(other.stream(rows[23:]), wanted)
    other.fmu.freeFMUState(again)
    spoilt = bytearray(kept)
    spoilt[-9] ^= 1
    for wrong in (bytes(spoilt), kept[:-1], b""):
        with pytest.raises(FMICallException):
            read(wrong)
        assert "serialised state" in other.told[-1][1]


@both
def test_a_state_of_another_fmu_is_refused_wherever_it_is_given(version, unit, bundle_of):
    rows = random_inputs(bundle_of("hybrid+all").predictor, 30, 0)
    made, stranger = unit("hybrid+all", version).start(), unit("gru+quantiles", version).start()
    made.stream(rows[:10])
    foreign = stranger.fmu.getFMUState()
    before = made.fmu.serializeFMUState(own := made.fmu.getFMUState())
    get = made.fmu.fmi2GetFMUstate if version == 2 else made.fmu.fmi3GetFMUState
    for call in (
        lambda: made.fmu.setFMUState(foreign),
        lambda: made.fmu.serializeFMUState(foreign),
        lambda: get(made.fmu.component, ctypes.byref(foreign)),
    ):
        with pytest.raises(FMICallException):
            call()
        assert "another FMU" in made.told[-1][1]
    made.fmu.freeFMUState(own)
    assert made.fmu.serializeFMUState(made.fmu.getFMUState()) == before  # nothing was taken over
    stranger.fmu.setFMUState(foreign)  # its own takes it
    stranger.fmu.freeFMUState(foreign)


def change_in_pytorch(predictor, rows, along, share=1e-4):
    """How the predictions of the last tick change with its inputs, by differences in double precision."""
    exact = copy.deepcopy(predictor).double()
    x = torch.from_numpy(np.stack([rows, rows]).astype(float))
    x[:, -1] += share * torch.from_numpy(np.stack([along, -along]))
    with torch.inference_mode():
        state = exact.initial_state(2, x)
        parts = [exact.predict(x, state)[0][:, -1].flatten(1)]
        if exact.output.coverages:
            bounds = exact.intervals(x, exact.initial_state(2, x))[0][:, -1]
            parts += [bounds[:, :, side].flatten(1) for side in (0, 1)]
        found = torch.cat(parts, dim=1).numpy()
    return (found[0] - found[1]) / (2.0 * share)


@both
@pytest.mark.parametrize("network", ["hybrid+all", "gru+quantiles", "lstm+hybrid physics"])
def test_derivatives_are_those_of_pytorch(network, version, unit, bundle_of):
    predictor = bundle_of(network).predictor
    rows, (_, spread) = random_inputs(predictor, 40, 0), usual_range(predictor)
    made = unit(network, version).start()
    assert re.search(r'DirectionalDerivatives?="true"', (made.folder / "modelDescription.xml").read_text())
    made.stream(rows[:-1])
    made.set(rows[-1])
    state, after = made.fmu.getFMUState(), made.get(made.outputs)
    rng = np.random.default_rng(4)
    for _ in range(4):
        along = spread * rng.normal(size=len(spread))
        wanted = change_in_pytorch(predictor, rows, along)
        found = made.fmu.getDirectionalDerivative(made.outputs, made.inputs, along)
        assert np.abs(found - wanted).max() <= 1e-4 * np.abs(wanted).max()
    single = made.fmu.getDirectionalDerivative(made.outputs[-1:], made.inputs[1:2], [spread[1]])
    wanted = change_in_pytorch(predictor, rows, spread * (np.arange(len(spread)) == 1))
    assert single == pytest.approx(wanted[-1:], abs=1e-4 * np.abs(wanted).max())
    np.testing.assert_array_equal(made.get(made.outputs), after)  # asking changes nothing
    fresh = unit(network, version).start()
    np.testing.assert_array_equal(made.stream(rows[-1:])[0], fresh.stream(rows)[-1])
    made.fmu.setFMUState(state)
    np.testing.assert_array_equal(made.fmu.getDirectionalDerivative(made.outputs, made.inputs, along), found)
    made.fmu.freeFMUState(state)
    made.set([np.nan], made.inputs[:1])
    with pytest.raises(FMICallException) as refused:
        made.fmu.getDirectionalDerivative(made.outputs, made.inputs[:1], [1.0])
    assert refused.value.status == 2
    assert "no derivatives: the inputs as they are" in made.told[-1][1]


@both
def test_calls_that_make_no_sense_are_refused(version, unit, unpacked, fmi):
    with pytest.raises(Exception, match="instantiate"):
        fmi.Unit(unpacked("lstm", version), version, token="{another}")
    made = unit("lstm", version)
    with pytest.raises(FMICallException):
        made.go()
    made.start()
    for call in (
        lambda: made.set([1.0], [made.outputs[0]]),
        lambda: made.get([10_000]),
        lambda: made.get([made.refs["status"]]),
        lambda: made.fmu.getBoolean([made.inputs[0]]),
        lambda: made.fmu.getDirectionalDerivative([made.outputs[0]], [made.inputs[0]], [1.0]),  # inputs were never set
        lambda: made.fmu.getDirectionalDerivative([made.inputs[0]], [made.inputs[0]], [1.0]),
        lambda: made.fmu.getDirectionalDerivative([made.outputs[0]], [made.outputs[0]], [1.0]),
        lambda: made.fmu.setBoolean([made.inputs[0]], [True]),
        lambda: made.fmu.setDebugLogging(True, ["unheard of"]),
    ):
        made.told.clear()
        with pytest.raises(FMICallException):
            call()
        assert made.told
