"""Virtual sensors whose networks take turns: a slower rate, held residuals, and what is missing."""

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.monitor.residuals.base import FitMaterial, SourceParts
from edp.monitor.residuals.virtual_sensors import VirtualSensors, VirtualSensorsSpec
from edp.testing.monitor import rig_sessions

EVERY, TICKS = 3, 200


@pytest.fixture(scope="module")
def sessions():
    return rig_sessions(5, TICKS, seed=6)


@pytest.fixture(scope="module")
def source(sessions):
    spec = VirtualSensorsSpec(every=EVERY, units=4, lags_s=(0.01, 0.06), min_explained=-0.9)
    material = FitMaterial(sessions[:4], sessions[4:], sessions[0].channels, 100.0, minutes=0.01)
    return spec.fit(material)


def places(source):
    """First tick of the network of each residual."""
    return np.repeat(np.arange(len(source.bundles)) % EVERY, [len(b.task.targets) for b in source.bundles.values()])


@pytest.mark.long
def test_networks_run_at_the_slower_rate_one_after_the_other(source, sessions):
    assert {bundle.task.rate_hz for bundle in source.bundles.values()} == {100.0 / EVERY}
    # Both spans of less than a run and of two of them.
    assert {bundle.predictor.spec.backbone.lags for bundle in source.bundles.values()} == {(1, 2)}
    residuals, _ = source.run(sessions[0].select(source.inputs)[None], source.initial_state(1))
    changed = np.diff(residuals[0], axis=0) != 0.0
    for column, first in enumerate(places(source)):
        ticks = np.flatnonzero(changed[EVERY:, column]) + EVERY + 1
        assert {int(tick) % EVERY for tick in ticks} == {int(first)}
        assert np.isnan(residuals[0, :first, column]).all()
        assert np.isfinite(residuals[0, first:, column]).all()


def test_ticks_and_one_call_agree(source, sessions):
    rows = sessions[1].select(source.inputs)[None, :60].copy()
    rows[0, 20:24, 1] = np.nan
    whole, _ = source.run(rows, source.initial_state(1))
    for length in (1, 7):
        state, parts = source.initial_state(1), []
        for start in range(0, rows.shape[1], length):
            part, state = source.run(rows[:, start : start + length], state)
            parts.append(part)
        np.testing.assert_allclose(
            np.concatenate(parts, axis=1), whole, rtol=1e-3, atol=2e-4 * np.nanmax(np.abs(whole))
        )


def test_what_stood_in_for_a_missing_value_does_not_outlast_the_tick(source, sessions):
    rows = sessions[1].select(source.inputs)[None].copy()
    rows[0, 30, 0] = np.nan
    residuals, _ = source.run(rows, source.initial_state(1))
    reads = np.array([source.inputs[0] in names for names in source.reads])
    silent = np.isnan(residuals[0])
    for column, first in enumerate(places(source)):
        # Tick 30 is a run of the first network and of every third one; the others are silent for that tick alone.
        length = EVERY if first == 30 % EVERY else 1
        expected = np.arange(30, 30 + length) if reads[column] else []
        np.testing.assert_array_equal(np.flatnonzero(silent[EVERY:, column]) + EVERY, expected)


def test_files_hold_the_turns_and_earlier_ones_have_none(source):
    parts = source.parts()
    assert VirtualSensors.from_parts(parts).every == EVERY
    plain = {key: value for key, value in parts.plain.items() if key != "every"}
    assert VirtualSensors.from_parts(SourceParts(plain, parts.arrays, parts.bundles)).every == 1
    for every in (0, 1001, 2.5, True, "3"):
        broken = SourceParts({**plain, "every": every}, parts.arrays, parts.bundles)
        with pytest.raises(ValueError, match="an integer of 1 to 1000 must hold"):
            VirtualSensors.from_parts(broken)
    with pytest.raises(ConfigError, match="every"):
        VirtualSensorsSpec(every=0)
