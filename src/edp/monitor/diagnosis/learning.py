"""Fitting of a dictionary to simulated fault sessions: signatures, and parameters chosen on left-out sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError
from edp.monitor.diagnosis.causes import FaultClass
from edp.monitor.diagnosis.evidence import ONSET, Scatter, check_stretches, mean_features
from edp.monitor.diagnosis.matching import Candidates, Seen, candidates, judged, likelihoods
from edp.monitor.diagnosis.signatures import Dictionary, signatures_of
from edp.monitor.diagnosis.structure import confusions

Array = NDArray[np.float64]
CHANGING = (0.1, 0.3, 1.0)
TEMPERATURES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
WINDOW = 40
"""Number of healthy blocks added to the signature of a left-out session: about half a minute after an alarm."""
MIN_CHANGE = 3.0
"""Minimum size of a signature in healthy standard deviations of a window mean. Smaller ones would raise no alarm."""
UNUSUAL = 0.98
"""Fraction of the left-out fault sessions that the dictionary must explain."""
MAX_JUDGED = 240
"""Maximum number of left-out sessions for the choice of the parameters."""


@dataclass(frozen=True, eq=False)
class SimulatedFault:
    """Effect of a fault in one session.

    Attributes:
        draw: index of the session.
        owner: place of the fault in the classes.
        size: size of the fault.
        change: mean features at the onset and after it, less those of the sound twin, shape (2, features).
        sensors: readings of additional channels minus those of the same session without a fault, by name; standardised.
    """

    draw: int
    owner: int
    size: float
    change: Array
    sensors: Mapping[str, Array]


def check_healthy_blocks(lengths: Sequence[int]) -> None:
    """Refuse healthy sessions from which `fit_dictionary` could not learn, before faults are simulated.

    Args:
        lengths: blocks of each session.

    Raises:
        DataError: too few segments, or no session as long as what an alarm looks at.
    """
    check_stretches(lengths)
    if max(lengths) < ONSET + WINDOW:
        raise DataError(
            f"the longest healthy session has {max(lengths)} blocks, a diagnosis needs one of {ONSET + WINDOW}; bring "
            "a longer session, or leave the dictionary out (--machine none)"
        )


def fit_dictionary(
    summaries: Sequence[str],
    classes: Sequence[FaultClass],
    faults: Sequence[SimulatedFault],
    healthy: Sequence[Array],
    provenance: Mapping[str, object],
    seed: int = 0,
) -> Dictionary:
    """Fit signatures to all sessions; choose temperature, change fraction and bounds on left-out sessions.

    A left-out session is evaluated as an alarm would be: its change on top of a segment of a healthy session.

    Args:
        summaries: names of the monitor's summaries.
        classes: the faults.
        faults: their sessions, of one draw or more.
        healthy: conditioned rows of healthy sessions, shape (blocks, summaries) each.
        provenance: machine, seed, sessions.
        seed: seed for drawing the segments.

    Raises:
        DataError: too few healthy sessions, or a fault without a session.
    """
    scatter = Scatter.fit(healthy)
    whole = _dictionary(summaries, classes, faults, scatter, provenance)
    draws = sorted({fault.draw for fault in faults})
    if len(draws) < 2:
        return whole
    sessions = _select_left_out(summaries, classes, faults, scatter, healthy, seed)
    whole = _choose_dictionary(sessions, whole)
    return replace(whole, confusions=_confusions(sessions, whole))


@dataclass(frozen=True, eq=False)
class _Judged:
    """Left-out session: candidates of the dictionary without its draw, and the evidence seen by an alarm."""

    tried: Candidates
    fault: SimulatedFault
    seen: tuple[Seen, Seen]


def _dictionary(
    summaries: Sequence[str],
    classes: Sequence[FaultClass],
    faults: Sequence[SimulatedFault],
    scatter: Scatter,
    provenance: Mapping[str, object],
) -> Dictionary:
    changes = np.array([fault.change for fault in faults]) @ scatter.matrix
    owner, sizes = [fault.owner for fault in faults], [fault.size for fault in faults]
    signatures = signatures_of(classes, owner, sizes, changes)
    return Dictionary(tuple(summaries), tuple(classes), scatter, *signatures, provenance=provenance)


def _select_left_out(
    summaries: Sequence[str],
    classes: Sequence[FaultClass],
    faults: Sequence[SimulatedFault],
    scatter: Scatter,
    healthy: Sequence[Array],
    seed: int,
) -> list[_Judged]:
    """Return the sessions with a detectable change, each added to a healthy segment."""
    chance = np.random.default_rng([seed, 23])
    noise = [scatter.variance(blocks) for blocks in (ONSET, WINDOW)]
    long = [session for session in healthy if len(session) >= ONSET + WINDOW]
    sessions = []
    for draw in sorted({fault.draw for fault in faults}):
        others = [fault for fault in faults if fault.draw != draw]
        if {fault.owner for fault in others} != set(range(len(classes))):
            continue
        # Sizes of the ladder alone: what is strange is measured on them.
        tried = candidates(_dictionary(summaries, classes, others, scatter, {}), further=False)
        for fault in faults:
            if fault.draw != draw or not _would_be_found(fault.change @ scatter.matrix, noise):
                continue
            session = long[int(chance.integers(len(long)))]
            first = int(chance.integers(len(session) - ONSET - WINDOW + 1))
            ends = first, first + ONSET, first + ONSET + WINDOW
            means = [mean_features(session[ends[part] : ends[part + 1]]) for part in (0, 1)]
            at, after = ((scatter.directions(means[part] + fault.change[part]), noise[part]) for part in (0, 1))
            sessions.append(_Judged(tried, fault, (at, after)))
    keep = chance.permutation(len(sessions))[:MAX_JUDGED]
    return [sessions[row] for row in sorted(keep.tolist())]


def _would_be_found(change: Array, noise: Sequence[Array]) -> bool:
    """Return whether a direction is far enough off at the onset or after it."""
    return any(float(np.max(change[part] ** 2 / noise[part])) > MIN_CHANGE**2 for part in (0, 1))


def _choose_dictionary(judged_sessions: Sequence[_Judged], whole: Dictionary) -> Dictionary:
    """Choose change fraction and temperature with the least logarithmic loss, and a rarely exceeded misfit bound."""
    best, least = whole, np.inf
    for changing in CHANGING:
        found_by = [likelihoods(case.tried, case.seen, changing) for case in judged_sessions]
        for temperature in TEMPERATURES:
            numbers = replace(whole, changing=changing, temperature=temperature, strange=np.inf)
            matches = [judged(case.tried, *one, numbers) for case, one in zip(judged_sessions, found_by, strict=True)]
            pairs = zip(matches, judged_sessions, strict=True)
            loss = -sum(float(np.log(max(one.probabilities[case.fault.owner], 1e-6))) for one, case in pairs)
            if matches and loss < least:
                misfit = float(np.quantile([one.misfit for one in matches], UNUSUAL))
                best, least = replace(numbers, strange=max(misfit, 1.0)), loss
    return best


def _confusions(judged_sessions: Sequence[_Judged], whole: Dictionary) -> tuple[Any, ...]:
    """Return the pairs of faults that left-out sessions confuse; both signs of a fault count as one."""
    names = sorted({_name(fault) for fault in whole.classes})
    if not judged_sessions:
        return ()
    columns_by_name = {name: n for n, name in enumerate(names)}
    columns = np.array([columns_by_name[_name(fault)] for fault in whole.classes])
    probabilities = np.zeros((len(judged_sessions), len(names)))
    numbers = replace(whole, strange=np.inf)
    for row, case in enumerate(judged_sessions):
        one = judged(case.tried, *likelihoods(case.tried, case.seen, whole.changing), numbers)
        np.add.at(probabilities[row], columns, one.probabilities)
    truth = np.array([columns[case.fault.owner] for case in judged_sessions])
    further = sorted(judged_sessions[0].fault.sensors)
    sensors = {name: np.array([case.fault.sensors[name] for case in judged_sessions]) for name in further}
    return confusions(names, probabilities, truth, sensors)


def _name(fault: FaultClass) -> str:
    return ":".join(filter(None, (fault.kind, fault.site)))
