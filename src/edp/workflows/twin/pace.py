"""Lengths of free runs along slow and short logs: of one a second is few ticks, of the other three are too many."""

from __future__ import annotations

from dataclasses import replace

from edp.training.free_run import FreeRunSpec

SLOW_HZ = 10.0
"""Below it lengths in seconds say nothing, since a plant that is logged so is slow: at 0.25 Hz 3 s are a tick."""
MOST_TICKS = 100
"""Of the longest free run that is trained on along a slow log, as 1 s of an excavator's is."""
SHARES = (0.125, 0.25, 0.5, 1.0)
"""Lengths of the stages, of the longest one."""
VALIDATED = 1.5
"""Length of a free run that chooses, of the longest one that is trained on."""
MIN_TICKS = 16
"""Of the longest stage, below which its shares are hardly different."""


def paced(training: FreeRunSpec, rate_hz: float, block: int) -> FreeRunSpec:
    """Return the training with lengths in samples that suit slow or short logs; lengths in the settings are unchanged.

    On the Sjoberg arm, whose tick counts as a second, the chosen twin is 0.62 off (one seed), and networks with lengths
    of a league's own, all validated by one segment, 0.66 (median of five; `benchmarks/results`).

    Args:
        training: training settings.
        rate_hz: sample rate of the recordings.
        block: ticks that a fold leaves out; the longest free run takes half of it at most.
    """
    usual = FreeRunSpec()
    asked = max(training.lengths_s) * rate_hz
    slow = rate_hz < SLOW_HZ
    longest = min(max(asked, MOST_TICKS) if slow else asked, block // 2)
    named = (training.lengths_s, training.validation_s) != (usual.lengths_s, usual.validation_s)
    if named or longest < MIN_TICKS or not (slow or longest < asked):
        return training
    lengths_s = tuple(round(share * longest) / rate_hz for share in SHARES)
    return replace(training, lengths_s=lengths_s, validation_s=round(VALIDATED * longest) / rate_hz)
