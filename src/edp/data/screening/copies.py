"""Channels that are copies of another channel, and channels that contain future values.

A *copy* is a channel that equals another channel with a delay, a scale and additional noise. Its residual has no linear
relation to any channel, so the copy adds no information to the past of the original. A *leak of the future* is a
channel that the present and past of the trusted channels do not explain, but that the future of one of them explains:
shifted, smoothed to both sides, or differentiated across the present. A sensor cannot produce such a signal.

A channel that *causes* a trusted channel through invertible, noise-free dynamics looks like a leak. Declare such a
channel as trusted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.screening.compiled import spread
from edp.data.screening.linear import Tap, gram, peaks, unexplained
from edp.data.screening.result import Array, Flag, FlagKind
from edp.wording import number, typed

LEAKING, DETERMINED = 0.25, 0.5
"""Maximum fraction of the unexplained variance that may remain after adding the future, for a leak. The second value
applies if hardly any variance remains, for example at the ends of segments."""
HARDLY = 0.01
"""Fraction of the variance below which a remainder counts as hardly any variance."""
DIFFERENCING = 2.5
"""Sum of the absolute weights of the future above which the future enters as differences. Leaks that are derivatives
have such weights, but also causes whose effect is inverted. Shifts and means have a sum of 2 or less."""
EXACT_SHARE = 0.95
"""Minimum fraction of the remaining variance that differences must explain for a leak. Sensor noise keeps causes below
this fraction."""
TELLING = 1e-4
"""Minimum fraction of the variance unexplained by the past. Below it, a test for the future is not possible."""
MATERIAL = 0.15
"""Correlation of a copy's residual with any channel above which the residual contains more than noise."""
SEEN = 0.7
"""Maximum lag of a noisy copy, as a fraction of the largest searched lag."""
RELATED = 0.7
"""Minimum correlation of a noisy copy with its original."""
EXPLAINED = 0.01
"""Maximum fraction of a channel's variance unexplained by other channels (present and past), for a channel that is
composed of them."""
SLACK = 1
"""Lag in samples up to which an exact copy counts as simultaneous."""
_FAR = 30
"""Number of future samples searched for a leak. For a leak farther in the future, the samples around the correlation
peak are searched."""
_NEAR_PAST = range(21)
"""Delays in samples of the source channels. They are dense, because effects of the past must not count as effects of
the future."""
_LONG_PAST = range(61)
_SPARSE_PAST = (0, 1, 2, 4, 7, 12, 20)
"""Delays in samples of all other channels. They are sparse, because the model has dozens of channels and its cost grows
with the third power of their number."""
_MAX_TRUSTED = 40
"""Maximum number of trusted channels in a model, which limits its cost. The channels with the strongest correlation are
used."""
_PARTNERS = 2


@dataclass(frozen=True, eq=False)
class CopiedChannel:
    """A channel that copies another: ``copy[t] = gain * source[t - lag] + noise``; `lag` is negative for a leader."""

    copy: int
    source: int
    lag: int
    correlation: float


def find_leaks(
    names: Sequence[str], correlations: Array, trusted: Sequence[int], targets: Sequence[int], flagged: Sequence[int]
) -> list[Flag]:
    """Return the channels that the future of a trusted channel explains.

    Args:
        names: channels.
        correlations: ``[reach + lag, i, j]`` of ``x_i[t + lag]`` and ``x_j[t]``, over all segments.
        trusted: columns of the channels that are known to be measured.
        targets: columns of the targets.
        flagged: columns that need no evaluation, such as targets.
    """
    reach = len(correlations) // 2
    far, near = min(_FAR, reach // 3), [a for a in _NEAR_PAST if a <= reach // 3]
    sparse = [a for a in _SPARSE_PAST if a <= reach // 3]
    _, best = peaks(correlations, -reach, reach)
    strength = np.abs(best)
    lead, _ = peaks(correlations, -reach, reach)

    def judge(channel: int) -> Flag | None:
        base = sorted((k for k in trusted if k != channel), key=lambda k: -strength[channel, k])[:_MAX_TRUSTED]
        sources = list(dict.fromkeys([*base[:_PARTNERS], *(k for k in targets if k != channel)]))
        # a channel far ahead of its source is treated as if its lead were moderate
        ahead = {k: max(far, min(reach - max(near), -int(lead[channel, k]) + 2)) for k in sources}
        past = [(k, a) for k in base for a in (near if k in sources else sparse)]
        future = [(k, -a) for k in sources for a in range(max(1, ahead[k] - far + 1), ahead[k] + 1)]
        future = [tap for tap in future if -tap[1] + max(near) <= reach]
        before, after = unexplained(correlations, channel, past, future)
        if before < TELLING or after > (DETERMINED if after < HARDLY else LEAKING) * before:
            return None
        return _leak(names, correlations, channel, past, future, (before, after))

    leaks = spread(judge, [k for k in range(len(names)) if k not in set(flagged)])
    return [flag for flag in leaks if flag is not None]


def _leak(
    names: Sequence[str],
    correlations: Array,
    channel: int,
    past: list[Tap],
    future: list[Tap],
    left: tuple[float, float],
) -> Flag | None:
    """Return the flag with the channel whose future explains most, and its lead; None if the channel may be a cause."""
    gains = {}
    for source in dict.fromkeys(k for k, _ in future):
        alone = unexplained(correlations, channel, past, [tap for tap in future if tap[0] == source])
        gains[source] = alone[1]
    source = min(gains, key=lambda k: gains[k])
    # the tap of the future with the largest share in the linear fit
    taps = [*past, *(tap for tap in future if tap[0] == source)]
    # Neighbouring samples are nearly equal: without it their weights would be large and of turning sign.
    joint = gram(correlations, taps, taps) + 1e-5 * np.eye(len(taps))
    weights = np.linalg.solve(joint, gram(correlations, taps, [(channel, 0)])[:, 0])[len(past) :]
    ahead = -taps[len(past) + int(np.abs(weights).argmax())][1]
    share = 1.0 - left[1] / left[0]
    differences = float(np.abs(weights).sum()) > DIFFERENCING
    if differences and share < EXACT_SHARE:
        return None
    return Flag(
        names[channel],
        FlagKind.LEAK,
        names[source],
        -ahead,
        share,
        f"the pasts of the other channels leave {typed(left[0], 3)} of its variance; {names[source]} up to {ahead} "
        "samples "
        f"later takes away {100 * share:.0f} % of that: it knows what has not happened yet"
        + (f" (or it causes {names[source]}: then name it as trusted)" if differences else ""),
    )


def find_copies(correlations: Array, least: float) -> list[CopiedChannel]:
    """Return pairs in which one channel may be a copy: its remainder is unrelated to all channels, at all lags.

    Args:
        correlations: ``[reach + lag, i, j]``, over all segments.
        least: correlation from which a channel that is not ahead counts as a copy, whatever is left of it.
    """
    reach = len(correlations) // 2
    lags, best = peaks(correlations, -reach, reach)
    candidates = [(i, j) for i, j in zip(*np.nonzero(np.abs(best) >= RELATED)) if i != j]

    def judge(pair: tuple[int, int]) -> CopiedChannel | None:
        i, j = int(pair[0]), int(pair[1])
        lag, value = int(lags[i, j]), float(best[i, j])
        # The peak may lie beyond the search.
        if abs(lag) >= reach:
            return None
        # A leading channel may be the reference of a controlled machine, so its residual is always tested.
        exact = abs(value) >= least and lag >= -SLACK
        # the residual can only be tested with enough lags on both sides
        if not exact and (abs(lag) > SEEN * reach or rest_related(correlations, i, j, lag, value) > MATERIAL):
            return None
        return CopiedChannel(i, j, lag, value)

    return [pair for pair in spread(judge, candidates) if pair is not None]


def rest_related(correlations: Array, i: int, j: int, lag: int, value: float) -> float:
    """Return the largest correlation of ``x_i[t] - value x_j[t - lag]`` with any channel but i, at any lag.

    If i leads, the changes of the channels from sample to sample are included. They show the relation between a
    reference and a machine that follows it, even if both are slow.
    """
    reach = len(correlations) // 2
    shown = np.arange(max(-reach, lag - reach), min(reach, lag + reach) + 1) + reach
    rest = correlations[shown, i, :] - value * correlations[shown - lag, j, :]
    rest[:, i] = 0.0
    most = float(np.abs(rest).max())
    if lag < -SLACK:
        steps = np.sqrt(2.0 * np.maximum(1.0 - np.diagonal(correlations[reach + 1]), 1e-6))
        steps[i] = np.inf
        most = max(most, float((np.abs(np.diff(rest, axis=0)) / steps).max()))
    # Correlations of the rest itself: divided by its own deviation, which is zero for an exact copy.
    return most / math.sqrt(max(1.0 - value * value, 1e-9))


def copy_flags(
    names: Sequence[str], pairs: Sequence[CopiedChannel], trusted: set[int], innovation: Array, settled: set[int]
) -> list[Flag]:
    """Flag the copy of each pair.

    The original is the trusted channel, otherwise the earlier one, otherwise the smoother one.

    Args:
        names: channels.
        pairs: pairs of equal channels, usually in both directions.
        trusted: columns of the channels known to be measured; never flagged.
        innovation: fraction of each channel's variance that its own past does not explain, ``(channel,)``.
        settled: columns that are already flagged and cannot be originals.
    """
    flags: dict[int, Flag] = {}
    # Closest pairs first: of a chain of copies each is named after its nearest original.
    for pair in sorted(pairs, key=lambda p: -abs(p.correlation)):
        copy, source = pair.copy, pair.source
        if {copy, source} & settled or copy in trusted or copy in flags:
            continue
        if source not in trusted:
            late = pair.lag > SLACK or (
                abs(pair.lag) <= SLACK and (innovation[copy], names[copy]) > (innovation[source], names[source])
            )
            if not late or source in flags:
                continue
        flags[copy] = _copy_flag(names, pair, source in trusted)
    return list(flags.values())


def _copy_flag(names: Sequence[str], pair: CopiedChannel, trusted: bool) -> Flag:
    name, source, value = names[pair.copy], names[pair.source], abs(pair.correlation)
    if pair.lag < -SLACK and trusted:
        text = (
            f"shows {source} {-pair.lag} samples before {source} itself does (correlation {number(value, 4)}): it "
            "knows the "
            "future, or a faster sensor measures the same; if the latter, name it as trusted"
        )
        return Flag(name, FlagKind.LEAK, source, pair.lag, value, text)
    if abs(pair.lag) <= SLACK:
        return Flag(
            name, FlagKind.DUPLICATE, source, pair.lag, value, f"equals {source} (correlation {number(value, 4)})"
        )
    text = (
        f"is {source} {pair.lag} samples later (correlation {number(value, 4)}), and what is left of it relates to "
        "nothing"
    )
    if not trusted:
        text += f"; or {source} knows its future: see which of the two is measured, and name it as trusted"
    return Flag(name, FlagKind.COPY, source, pair.lag, value, text)


def flag_explained(names: Sequence[str], correlations: Array, judged: Sequence[int], base: Sequence[int]) -> list[Flag]:
    """Return channels that the presents and pasts of others make up, one after the other, so that something remains.

    Args:
        names: channels.
        correlations: ``[reach + lag, i, j]``, over all segments.
        judged: columns that can be removed, in this order.
        base: explaining columns; they include the columns of `judged` that are not yet removed.
    """
    reach = len(correlations) // 2
    strength = np.abs(correlations).max(axis=0)
    remaining = list(base)
    flags = []
    for channel in judged:
        others = sorted((k for k in remaining if k != channel), key=lambda k: -strength[channel, k])
        near = others[:_PARTNERS]
        taps = [(k, a) for k in others for a in (_LONG_PAST if k in near else _SPARSE_PAST) if a <= reach]
        if not taps or (left := unexplained(correlations, channel, taps)[1]) > EXPLAINED:
            continue
        text = f"the presents and pasts of {names[near[0]]} and others make up all but {typed(100 * left, 2)} % of it"
        value = 1.0 - left
        flags.append(Flag(names[channel], FlagKind.REDUNDANT, names[near[0]], value=value, evidence=text))
        # From now on it explains no other channel, so that something remains of each set.
        remaining.remove(channel)
    return flags


def innovations(correlations: Array, order: int = 20) -> Array:
    """Share of each channel's variance that its own last `order` samples do not explain, ``(channel,)``."""
    reach = len(correlations) // 2
    order = min(order, reach)
    taps: NDArray[np.int64] = np.arange(1, order + 1)
    residuals = []
    for i in range(correlations.shape[1]):
        own: list[Tap] = [(i, int(a)) for a in taps]
        residuals.append(unexplained(correlations, i, own)[1])
    return np.array(residuals)
