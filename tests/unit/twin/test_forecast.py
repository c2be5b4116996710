"""Forecasts of twins: causal, the same as by hand, and what the gains of the observer mean."""

import numpy as np
import pytest

from edp.data.series import Series
from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError, DataError
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.forecast import GAINS, choose_gain, forecast
from edp.testing.twins import sample_actuators

AHEAD = (1, 4)


@pytest.fixture(scope="module", params=["static", "arx", "n4sid"])
def machine(request):
    """A twin with commands and measured answers of a stretch."""
    recording = sample_actuators(seed=1)
    channels = twin_channels(recording)
    series = channels.task().series(recording)
    twin = TWINS[request.param]().start(channels, fit_scales(channels, [series]), [series], 0)
    return twin, series.inputs[:400], series.targets[:400]


def by_hand(twin, commands, measured, tick, gain):
    """The forecast of one tick from public methods, a tick at a time."""
    prefix = twin.prefix_ticks
    state = twin.reset(commands[None, :prefix], measured[None, :prefix])
    for t in range(prefix, tick + 1):
        ports = state["answer"][0] + gain * (measured[t] - state["answer"][0])
        ports = ports.astype(np.float32)
        if t < tick:
            state = twin.step(commands[t][None], state, ports[None])[1]
    answers = []
    for ahead in range(max(AHEAD)):
        answer, state = twin.step(commands[tick][None], state, ports[None] if ahead == 0 else None)
        answers.append(answer[0])
    return np.array(answers)[np.array(AHEAD) - 1]


@pytest.mark.parametrize("gain", [1.0, 0.3])
def test_a_forecast_is_the_observer_and_a_free_run_with_the_command_held(machine, gain):
    twin, commands, measured = machine
    values = forecast(twin, commands, measured, AHEAD, gain)
    for tick in (twin.prefix_ticks, 200):
        expected = by_hand(twin, commands, measured, tick, gain)
        np.testing.assert_allclose(twin.scaled(values[tick]), twin.scaled(expected), atol=1e-3)
    assert np.isnan(values[: twin.prefix_ticks]).all()
    assert np.isfinite(values[twin.prefix_ticks :]).all()


def test_nothing_after_a_tick_changes_its_forecast(machine):
    twin, commands, measured = machine
    whole = forecast(twin, commands, measured, AHEAD)
    commands, measured = commands.copy(), measured.copy()
    commands[251:], measured[251:] = commands[251:][::-1], np.nan
    changed = forecast(twin, commands, measured, AHEAD)
    np.testing.assert_array_equal(changed[:251], whole[:251])
    assert not np.array_equal(changed[251:], whole[251:])


def test_with_a_gain_of_zero_the_twin_runs_free_from_the_prefix(machine):
    twin, commands, measured = machine
    prefix = twin.prefix_ticks
    state = twin.reset(commands[None, :prefix], measured[None, :prefix])
    free, _ = twin.rollout(commands[None, prefix:], state)
    values = forecast(twin, commands, measured, (1,), 0.0)
    np.testing.assert_allclose(twin.scaled(values[prefix:, 0]), twin.scaled(free[0]), atol=1e-3)


def test_blocks_of_moments_change_nothing(machine, monkeypatch):
    twin, commands, measured = machine
    whole = forecast(twin, commands, measured, AHEAD)
    monkeypatch.setattr("edp.networks.twin.forecast.BLOCK", 7)
    again = forecast(twin, commands, measured, AHEAD)
    np.testing.assert_allclose(twin.scaled(again), twin.scaled(whole), atol=1e-5)


def test_a_missing_sensor_leaves_its_port_free(machine):
    twin, commands, measured = machine
    silent = measured.copy()
    silent[100:, 0] = np.nan
    values = forecast(twin, commands, silent, AHEAD)
    assert np.isfinite(values[twin.prefix_ticks :]).all()


def test_a_start_beyond_an_end_stop_waits_for_one_within(machine):
    twin, commands, measured = machine
    far = measured.copy()
    far[:20, 2] += 2.0  # metres: no stroke of the machine
    values = forecast(twin, commands, far, AHEAD)
    settled = 20 + twin.prefix_ticks
    assert np.isnan(values[:settled]).all()
    np.testing.assert_array_equal(
        values[settled:], forecast(twin, commands[20:], measured[20:], AHEAD)[twin.prefix_ticks :]
    )
    far[:, 2] = 9.0
    with pytest.raises(DataError, match="beyond an end stop"):
        forecast(twin, commands, far, AHEAD)


@pytest.mark.long
def test_far_horizons_take_no_more_memory(machine, monkeypatch):
    twin, commands, measured = machine
    blocks = []
    rollout = twin.rollout
    monkeypatch.setattr(twin, "rollout", lambda held, *rest: (blocks.append(held.shape), rollout(held, *rest))[1])
    monkeypatch.setattr("edp.networks.twin.forecast.BLOCK_NUMBERS", 10_000)
    forecast(twin, commands[:80], measured[:80], (1000,))
    assert max(moments * ticks for moments, ticks, _ in blocks if ticks == 1000) * 8 <= 10_000


@pytest.mark.parametrize("horizons", [(), (0,), (3, 3), (1.5,), (True,), (1001,), (10**12,)])
def test_horizons_that_cannot_be_are_refused(machine, horizons):
    with pytest.raises(ConfigError, match="--horizon"):
        forecast(*machine, horizons)


@pytest.mark.parametrize("gain", [-0.1, 1.1, float("nan")])
def test_a_gain_outside_zero_to_one_is_refused(machine, gain):
    with pytest.raises(ConfigError, match="--observer-gain"):
        forecast(*machine, AHEAD, gain)


def test_the_gain_with_the_least_error_is_chosen(machine):
    twin, commands, measured = machine
    series = Series("stretch", commands, measured)

    def error(gain):
        values = forecast(twin, commands, measured, AHEAD, gain)[..., :2]
        return np.array([np.nanmean(np.abs(values[:-k, at] - measured[k:, :2])) for at, k in enumerate(AHEAD)])

    errors = np.array([error(gain) for gain in GAINS])
    relative = (errors / errors.min(axis=0)).sum(axis=1)
    chosen = choose_gain(twin, [series], AHEAD)
    # The choice weighs velocities by their widths, which are alike here.
    assert relative[GAINS.index(chosen)] < 1.05 * relative.min()
    assert choose_gain(twin, [Series("short", commands[:5], measured[:5])], AHEAD) == GAINS[0]


def test_a_missing_command_is_named(machine):
    twin, commands, measured = machine
    commands = commands.copy()
    commands[300, 0] = np.nan
    with pytest.raises(DataError, match="is missing at tick 300"):
        forecast(twin, commands, measured, AHEAD)


def test_a_stretch_shorter_than_the_prefix_is_refused(machine):
    twin, commands, measured = machine
    with pytest.raises(DataError, match="prefix"):
        forecast(twin, commands[: twin.prefix_ticks - 1], measured[: twin.prefix_ticks - 1], AHEAD)
