"""Faults that the present sensors cannot distinguish, and additional sensors that would separate them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.settings.bounds import SHARE, check_bounds, check_texts

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
APART = 0.25
"""Maximum error rate of a test between two faults that count as distinguishable. Guessing has 0.5."""
MAX_PAIRS = 400
LONGEST_NAME = 300
MIN_SESSIONS = 3
"""Minimum number of sessions per fault for a statement on the confusion of two faults."""


@dataclass(frozen=True)
class Confusion:
    """Two indistinguishable faults.

    Attributes:
        first: kind and site of one, and `second` of the other.
        error: share of wrong answers between the two on sessions that nothing was fitted to.
        sensor: channel that would separate them best; empty where none does.
        sensor_error: fraction confused with the additional sensor; None without one.

    Raises:
        ConfigError: a share outside of 0 to 1, or a name that is too long.
    """

    first: str
    second: str
    error: float
    sensor: str = ""
    sensor_error: float | None = None

    def __post_init__(self) -> None:
        check_bounds("confusion", self, error=SHARE, sensor_error=SHARE)
        check_texts("confusion", (self.first, self.second, self.sensor), LONGEST_NAME)


def confusions(
    names: Sequence[str], probabilities: Array, truth: Numbers, sensors: Mapping[str, Array]
) -> tuple[Confusion, ...]:
    """Return pairs of indistinguishable faults, the worst first.

    Args:
        names: names of the faults.
        probabilities: probability of each fault for sessions not used in the fit, shape (sessions, faults).
        truth: index of the true fault of each session, shape (sessions,).
        sensors: standardised values of an additional channel in each session, by its name, shape (sessions, values).
    """
    logits = np.log(np.maximum(probabilities, 1e-12))
    rows = {fault: np.flatnonzero(truth == fault) for fault in range(len(names))}
    pairs = []
    for a in range(len(names)):
        for b in range(a + 1, len(names)):
            if min(len(rows[a]), len(rows[b])) < MIN_SESSIONS:
                continue
            error = 0.5 * (_measure_confusion(logits[rows[a]], a, b) + _measure_confusion(logits[rows[b]], b, a))
            if error > APART:
                pairs.append((error, a, b))
    pairs.sort(key=lambda pair: (-pair[0], pair[1], pair[2]))
    result = []
    for error, a, b in pairs[:MAX_PAIRS]:
        sensor, sensor_error = _best_sensor(rows[a], rows[b], sensors)
        helps = sensor_error is not None and sensor_error <= min(APART, 0.5 * error)
        result.append(Confusion(names[a], names[b], error, *((sensor, sensor_error) if helps else ("", None))))
    return tuple(result)


def _measure_confusion(logits: Array, right: int, wrong: int) -> float:
    """Share of sessions of `right` for which `wrong` is more likely; ties count half."""
    lead = logits[:, right] - logits[:, wrong]
    return float(np.mean((lead < 0.0) + 0.5 * (lead == 0.0)))


def _best_sensor(first: Numbers, second: Numbers, sensors: Mapping[str, Array]) -> tuple[str, float | None]:
    """Return the channel with the fewest errors between two groups of sessions, by leave-one-out means."""
    best: tuple[str, float | None] = "", None
    for name in sorted(sensors):
        values = sensors[name]
        error = 0.5 * (
            _measure_separability(values[first], values[second]) + _measure_separability(values[second], values[first])
        )
        if best[1] is None or error < best[1]:
            best = name, error
    return best


def _measure_separability(own: Array, other: Array) -> float:
    """Return the fraction of sessions nearer to the other group's mean than to their own leave-one-out mean."""
    means = (own.sum(axis=0) - own) / (len(own) - 1)
    to_own = ((own - means) ** 2).sum(axis=1)
    to_other = ((own - other.mean(axis=0)) ** 2).sum(axis=1)
    return float(np.mean(to_own >= to_other))
