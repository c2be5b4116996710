"""Forecasts of a twin: an observer follows the measured machine, and each sample starts a prediction from it.

The observer is Luenberger's with one gain. Before tick t every port reads

    z[t] = a[t] + g (m[t] - a[t])

with the twin's own output a for sample t and the measurement m; a missing measurement leaves the port free. From the
resulting state, the twin runs free with the constant commands of sample t: ``f[t, k]`` is its output for sample t + k.
It does not read any data after sample t.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.networks.twin.base import Twin, TwinState
from edp.networks.twin.scales import Array
from edp.settings.bounds import integer, span

GAINS = (1.0, 0.3, 0.1)
"""Observer gains as fractions of the innovation per sample: measured mode, and two that smooth noise. A grey box of a
simulated M22 predicts ten samples ahead with 0.78, 0.72 and 0.71 mm/s. ARX needs 1, since it reads its own past outputs
as measurements."""
CHOICE_LOGS, CHOICE_TICKS = 3, 1500
"""Number of segments, and number of samples of each segment, on which an observer gain is selected. A few thousand
samples determine the errors to a few per cent."""
BLOCK, BLOCK_NUMBERS = 4096, 4_000_000
"""Maximum number of predictions computed at a time, and maximum number of values in these simulations. The states need
a few MB, the simulations some tens of MB."""
MOST_AHEAD = 1000
"""Maximum prediction horizon in samples. Predictions assume constant commands, which is not useful over longer times.
"""


def check_horizons(horizons: Sequence[int]) -> None:
    """Raise ConfigError for missing, duplicate or invalid horizons (number of samples).

    Raises:
        ConfigError: the one that cannot be.
    """
    allowed = integer(1, MOST_AHEAD)
    wrong = [k for k in horizons if not allowed.holds(k)]
    if not horizons or wrong or len(set(horizons)) < len(horizons):
        came = f"{wrong[0]}" if wrong else ", ".join(map(str, horizons)) or "none"
        raise ConfigError(f"--horizon {came}: {allowed.rule('horizon')} must hold, each number once")


def check_gain(gain: float) -> None:
    """Refuse a gain outside of 0 to 1.

    Raises:
        ConfigError: it is.
    """
    allowed = span(0.0, 1.0)
    if not allowed.holds(gain):
        raise ConfigError(f"--observer-gain {gain}: {allowed.rule('observer_gain')} must hold")


def choose_gain(twin: Twin, series: Sequence[Series], horizons: Sequence[int]) -> float:
    """Return the gain of `GAINS` with the least relative velocity error at the nearest and farthest horizon.

    Args:
        twin: any formulation.
        series: segments with commands as inputs and twin outputs as targets; only the first segments are used.
        horizons: horizons in samples.
    """
    ends, parts = sorted({min(horizons), max(horizons)}), list(series)[:CHOICE_LOGS]
    least = twin.prefix_ticks + ends[-1] + 1
    errors = np.zeros((len(GAINS), len(ends)))
    for part in parts:
        commands, measured = part.inputs[:CHOICE_TICKS], part.targets[:CHOICE_TICKS]
        if len(commands) < least:
            continue
        speeds = twin.channels.parts["velocities"]
        for row, gain in enumerate(GAINS):
            answers = forecast(twin, commands, measured, ends, gain)[..., speeds]
            for at, k in enumerate(ends):
                apart = (answers[:-k, at] - measured[k:, speeds]) / twin.scales.answer_width[speeds]
                errors[row, at] += np.nansum(np.abs(apart))
    if not errors.any():
        return GAINS[0]
    # Errors of short and long horizons differ by a factor, so each is divided by its best value.
    return GAINS[int(np.argmin((errors / errors.min(axis=0)).sum(axis=1)))]


def forecast(twin: Twin, commands: Array, measured: Array, horizons: Sequence[int], gain: float = 1.0) -> Array:
    """Return the k-step-ahead outputs of a twin at each sample of a segment, from rows up to that sample.

    Args:
        twin: any formulation.
        commands: ``(tick, command)``, finite.
        measured: ``(tick, output)``, NaN where a sensor is missing.
        horizons: horizons in samples.
        gain: gain of the observer; see `choose_gain`.

    Returns:
        ``(tick, horizon, output)``, SI units; NaN in the ticks before the observer has settled: `Twin.prefix_ticks`
        from the first tick on at which the twin can start.

    Raises:
        ConfigError: a horizon or a gain that cannot be.
        DataError: fewer ticks than the prefix, a missing command, or a start that the twin refuses.
    """
    check_horizons(horizons)
    check_gain(gain)
    begin, ticks = _begin(twin, measured), len(commands)
    settled = begin + twin.prefix_ticks
    answers = np.full((ticks, len(horizons), measured.shape[1]), np.nan, np.float32)
    state = twin.reset(commands[None, begin:settled], measured[None, begin:settled])
    _refuse_gaps(twin, commands)
    runner = twin.runner()
    places = np.asarray(horizons) - 1
    moments = max(1, min(BLOCK, BLOCK_NUMBERS // (max(horizons) * (commands.shape[1] + measured.shape[1]))))
    for first in range(settled, ticks, moments):
        block = slice(first, min(first + moments, ticks))
        states, ports = [], np.empty((block.stop - first, measured.shape[1]), np.float32)
        for row, t in enumerate(range(first, block.stop)):
            own = state["answer"][0]
            # Without a measurement the difference and the port are NaN, which marks a free port.
            ports[row] = own + np.float32(gain) * (measured[t] - own) if gain > 0.0 else np.nan
            states.append(state)
            state = runner.step(commands[t], state, ports[row])
        answers[block] = _simulate_ahead(twin, commands[block], _stack_states(states), ports, max(horizons))[:, places]
    return answers


def _begin(twin: Twin, measured: Array) -> int:
    """Return the first tick at which the twin can start: all measured, no stroke far beyond an end stop.

    The first without one.
    """
    there = np.asarray(np.isfinite(measured).all(axis=1))
    possible = np.flatnonzero(there & twin.is_within_stops(np.where(there[:, None], measured, np.float32(0.0))))
    # If there is none, the reset at the first sample raises the error.
    return int(possible[0]) if len(possible) and len(measured) - possible[0] >= twin.prefix_ticks else 0


def _simulate_ahead(twin: Twin, commands: Array, states: TwinState, ports: Array, ticks: int) -> Array:
    """Simulate from each state with its command held constant, ``(moment, tick, output)``."""
    constant_commands = np.repeat(commands[:, None], ticks, axis=1)
    fed = np.full((len(commands), ticks, ports.shape[1]), np.nan, np.float32)
    fed[:, 0] = ports
    return twin.rollout(constant_commands, states, fed)[0]


def _stack_states(states: Sequence[TwinState]) -> TwinState:
    """Join states of single machines to a batch, rounded to the twin's precision."""
    return {
        name: np.concatenate([np.asarray(state[name], np.float32) for state in states], axis=0) for name in states[0]
    }


def _refuse_gaps(twin: Twin, commands: Array) -> None:
    gaps = np.argwhere(~np.isfinite(commands))
    if len(gaps):
        tick, which = (int(i) for i in gaps[0])
        raise DataError(
            f"command '{twin.channels.commands[which].name}' is missing at tick {tick}; a twin has no other source for "
            "it: repair the log, for example with --repair nan=hold"
        )
