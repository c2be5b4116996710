"""Matching of the rows since an onset with the dictionary: explaining faults, sizes and probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause, FaultClass
from edp.monitor.diagnosis.evidence import mean_features, parts_of
from edp.monitor.diagnosis.sentences import UNKNOWN, cause_words
from edp.monitor.diagnosis.signatures import Dictionary

Array = NDArray[np.float64]
Seen = tuple[Array, Array]
"""Mean features projected on the directions of the evidence, and their healthy variance."""
GRID = 12
"""Number of fault sizes tried, with logarithmic spacing from the smallest simulated size."""
BEYOND = 1.3
"""Upper end of that grid relative to the largest simulated size."""
FURTHER = (2.0, 4.0, 8.0)
"""Larger fault sizes that are tried, relative to the largest simulated size. Signatures are extrapolated to them, and
clipped features stay at their clip.
"""
MAX_STRANGE = 0.5
"""Probability of an unknown fault above which larger fault sizes are tried."""
MAX_SHARE = 100.0
"""Maximum size of faults measured in percent."""
MIN_SIZE = 0.5
"""Smallest fault size that is tried, relative to the smallest simulated size."""
MAX_CAUSES = 8


@dataclass(frozen=True, eq=False)
class Match:
    """Fit of each fault to the evidence.

    Attributes:
        probabilities: probability of each fault, shape (faults,). Together with `none` they sum to 1.
        sizes: the most likely size of each fault, NaN for faults without, shape (faults,).
        none: probability that no fault of the dictionary explains the evidence.
        misfit: mean squared misfit of a direction under the best fault, in its own variance.
    """

    probabilities: Array
    sizes: Array
    none: float
    misfit: float


def match(dictionary: Dictionary, rows: Array, fresh: bool = True) -> Match:
    """Compare the rows since an onset with all signatures.

    A fault's likelihood is the mean over its sizes of a normal density around its signatures at the onset and after it,
    which are interpolated between the sizes that were simulated. Its variance is that of a healthy mean over so many
    blocks, and a share of the squared signature: the same fault looks otherwise from session to session.

    Args:
        dictionary: dictionary of the monitor.
        rows: conditioned rows since the onset, NaN where missing, shape (blocks, summaries).
        fresh: whether they begin at an onset, not at an earlier alarm of a fault that has stayed.
    """
    seen: list[Seen | None] = []
    for part in parts_of(rows, fresh):
        if part is None:
            seen.append(None)
        else:
            directions = dictionary.scatter.directions(mean_features(part))
            seen.append((directions, dictionary.scatter.variance(len(part))))
    return match_directions(dictionary, seen)


def match_directions(dictionary: Dictionary, seen: Sequence[Seen | None]) -> Match:
    """Match from the directions at the onset and later; None for a part without rows."""
    matched = _match_rows(dictionary, seen, further=False)
    # Carried on, signatures are coarse: they are asked only where no size of the ladders explains the evidence.
    return matched if matched.none <= MAX_STRANGE else _match_rows(dictionary, seen, further=True)


def _match_rows(dictionary: Dictionary, seen: Sequence[Seen | None], further: bool) -> Match:
    tried = _all_candidates(dictionary, further)
    return judged(tried, *likelihoods(tried, seen, dictionary.changing), dictionary)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Every fault at every size that is tried.

    Attributes:
        owner: number of the fault, ascending, shape (candidates,).
        sizes: sizes in the unit of the fault, shape (candidates,); NaN for faults without a size.
        signatures: signatures at the onset and after it, shape (2, candidates, features).
        firsts: first candidate of each fault, shape (faults,).
    """

    owner: NDArray[np.int64]
    sizes: Array
    signatures: Array
    firsts: NDArray[np.int64]


@lru_cache(maxsize=2)
def _all_candidates(dictionary: Dictionary, further: bool) -> Candidates:
    """Return the candidates of the monitor, with which every alarm is compared."""
    return candidates(dictionary, further)


def candidates(dictionary: Dictionary, further: bool = True) -> Candidates:
    """Return all candidates of `match`; `further` adds sizes outside the ladders."""
    parts = [_list_sizes(dictionary, number, fault, further) for number, fault in enumerate(dictionary.classes)]
    counts = np.array([len(sizes) for sizes, _ in parts])
    return Candidates(
        np.repeat(np.arange(len(parts)), counts),
        np.concatenate([sizes for sizes, _ in parts]),
        np.concatenate([signatures for _, signatures in parts], axis=1),
        np.concatenate([[0], np.cumsum(counts)[:-1]]),
    )


def likelihoods(tried: Candidates, seen: Sequence[Seen | None], changing: float) -> tuple[Array, Array]:
    """Return the logarithms of the densities of the evidence, and mean squared misfits, shape (candidates,) each."""
    logs, misfits, count = np.zeros(len(tried.owner)), np.zeros(len(tried.owner)), 0
    for part, entry in enumerate(seen):
        if entry is None:
            continue
        directions, noise = entry
        variance = noise + changing * tried.signatures[part] ** 2
        squares = (directions - tried.signatures[part]) ** 2 / variance
        logs -= 0.5 * (squares + np.log(variance)).sum(axis=1)
        misfits += squares.mean(axis=1)
        count += 1
    return logs, misfits / max(count, 1)


def judged(tried: Candidates, logs: Array, misfits: Array, dictionary: Dictionary) -> Match:
    """Return the probabilities of the faults from the densities of the candidates."""
    scaled = logs / dictionary.temperature
    best = np.maximum.reduceat(scaled, tried.firsts)
    sums = np.add.reduceat(np.exp(scaled - best[tried.owner]), tried.firsts)
    counts = np.diff(np.append(tried.firsts, len(scaled)))
    of_faults = best + np.log(sums / counts)
    shares = np.exp(of_faults - logsumexp(of_faults))
    # The last of equals would do as well; the first is the smaller size.
    chosen = np.array([first + int(scaled[first : first + n].argmax()) for first, n in zip(tried.firsts, counts)])
    misfit = float(misfits[chosen[int(of_faults.argmax())]])
    # Even odds at the misfit that hardly any left-out session reached, certainty at half as much again.
    none = float(np.clip(misfit / dictionary.strange - 0.5, 0.0, 1.0))
    return Match((1.0 - none) * shares, tried.sizes[chosen], none, misfit)


def _list_sizes(dictionary: Dictionary, number: int, fault: FaultClass, beyond: bool) -> tuple[Array, Array]:
    """Return the sizes of a fault that are tried and their signatures, shapes (sizes,) and (2, sizes, features)."""
    rows = dictionary.rows_of(number)
    signatures = dictionary.signatures[:, rows]
    if not fault.sizes:
        return np.array([np.nan]), signatures[:, :1]
    away = np.abs(dictionary.sizes[rows] - fault.neutral)
    sign = -1.0 if fault.sizes[0] < fault.neutral else 1.0
    ends = abs(fault.sizes[0] - fault.neutral), abs(fault.sizes[-1] - fault.neutral)
    within = np.geomspace(MIN_SIZE * ends[0], BEYOND * ends[1], GRID)
    most = (MAX_SHARE / ends[1] if fault.unit == "%" else np.inf) if beyond else 0.0
    further = np.array([times for times in FURTHER if times <= most])
    tried = np.concatenate([within, further * ends[1]])
    # From nothing at the neutral size; a little beyond the largest size that was simulated it stays as it was there.
    most_shares = np.where(np.arange(len(tried)) < GRID, 1.0, np.inf)
    simulated = np.concatenate([[0.0], away])
    values = np.concatenate([np.zeros((2, 1, signatures.shape[2])), signatures], axis=1)
    upper = np.clip(np.searchsorted(simulated, tried), 1, len(simulated) - 1)
    share = (tried - simulated[upper - 1]) / (simulated[upper] - simulated[upper - 1])
    share = np.clip(share, 0.0, most_shares)[:, None]
    between = (1.0 - share) * values[:, upper - 1] + share * values[:, upper]
    return fault.neutral + sign * tried, between


def causes_of(dictionary: Dictionary, matched: Match, most: int = MAX_CAUSES) -> tuple[Cause, ...]:
    """Return the most probable causes, the first from the most probable component.

    A part may have many kinds of faults that look alike: what a mechanic looks at first is the part whose faults
    together are the most likely, and of it the likeliest fault.
    """
    causes = [
        _cause(fault, float(matched.probabilities[number]), float(matched.sizes[number]))
        for number, fault in enumerate(dictionary.classes)
    ]
    parts: dict[str, float] = {}
    for cause in causes:
        parts[cause.component] = parts.get(cause.component, 0.0) + cause.probability
    causes.append(Cause(NONE_OF_THESE, "", "", "none", None, "", matched.none, UNKNOWN))
    parts[""] = matched.none
    return tuple(_sort_causes(causes, parts)[:most])


def _sort_causes(causes: Sequence[Cause], parts: dict[str, float]) -> list[Cause]:
    """Sort causes: the most probable fault of each of the three most probable components, then the others."""
    order = sorted(causes, key=lambda cause: (-cause.probability, cause.kind, cause.site))
    first = []
    for part in sorted(parts, key=lambda name: (-parts[name], name))[:3]:
        first.append(next(cause for cause in order if cause.component == part))
    return first + [cause for cause in order if cause not in first]


def _cause(fault: FaultClass, probability: float, size: float) -> Cause:
    if not fault.sizes:
        return Cause(
            fault.kind,
            fault.site,
            fault.component,
            fault.at_fault,
            None,
            "",
            probability,
            fault.words,
            None,
            fault.grave,
        )
    steps = np.abs(np.array(fault.sizes) - fault.neutral)
    grade = float(np.interp(np.log(abs(size - fault.neutral)), np.log(steps), np.linspace(0.0, 1.0, len(steps))))
    words = cause_words(fault, size)
    return Cause(
        fault.kind,
        fault.site,
        fault.component,
        fault.at_fault,
        size,
        fault.unit,
        probability,
        words,
        grade,
        fault.grave,
    )
