"""Channels whose relations are artefacts of how the recordings were cut: they identify the file, not the machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.data.screening.compiled import spread
from edp.data.screening.lagged import Lagged
from edp.data.screening.ranks import ranks_of
from edp.data.screening.result import Array, Flag, FlagKind
from edp.data.screening.table import CandidateTable, chunks

CLOCK = 0.98
"""Minimum rank correlation with time, in every segment, of a channel that only contains the time."""
STRONG = 0.6
"""Minimum correlation, in every segment, of a relation whose change of sign is reported."""
EXACT = 0.97
"""Minimum correlation, in every segment, of a relation whose change of gain is reported."""
GAIN = 1.5
"""Minimum ratio of the largest to the smallest gain that is reported as a change."""
STEADY, SAME = 1.25, 1.05
"""Maximum ratio of gains (90 % to 10 % quantile) that counts as one gain, for the detection of a changed sign and of an
absent relation."""
VISIBLE, ABSENT = 0.8, 0.3
"""Minimum correlation expected from gain and noise, and maximum correlation found, in a segment with an absent
relation."""


def dead_flags(table: CandidateTable) -> list[Flag]:
    """Flag channels that are constant, change between recordings only, or have missing values."""
    flags = [
        Flag(name, FlagKind.MISSING, value=1.0, evidence=f"{count} values are missing or infinite")
        for name, count in table.missing.items()
    ]
    for i in np.flatnonzero(~table.live):
        # 1e-6 of the mean: sums of float32 values differ by rounding between recordings of unequal length.
        if table.between[i] > 0.5 and np.ptp(table.sums[0][:, i]) > 1e-6 * max(1e-30, float(np.abs(table.mean[i]))):
            text = "constant within each recording, but not the same in all: it tells the file, not the machine"
            flags.append(Flag(table.names[i], FlagKind.ARTEFACT, value=1.0, evidence=text))
        else:
            flags.append(Flag(table.names[i], FlagKind.CONSTANT, value=1.0, evidence="never changes"))
    return flags


def clock_flags(table: CandidateTable, live: Sequence[int]) -> list[Flag]:
    """Return the channels that rise or fall throughout every recording."""

    def of_channel(i: int) -> float:
        flags = []
        for piece in table.pieces:
            values = max(piece.stretches, key=len)[:, i]
            # 2,000 rows identify a clock; ranking all rows would cost as much as the rank correlation itself.
            values = values[:: max(1, len(values) // 2_000)]
            if values.max() > values.min():
                flags.append(abs(float(np.corrcoef(ranks_of(values), np.arange(len(values)))[0, 1])))
        # The minimum over all segments is used, because a slow signal may rise throughout one segment.
        return min(flags) if len(flags) > len(table.pieces) // 2 else 0.0

    values = spread(of_channel, live)
    return [
        Flag(
            table.names[i],
            FlagKind.ARTEFACT,
            value=value,
            evidence=f"rises or falls throughout every recording (rank correlation with time {value:.3f} or more): it "
            "tells the time since the start",
        )
        for i, value in zip(live, values)
        if value >= CLOCK
    ]


def changing_flags(
    names: Sequence[str], lagged: Lagged, judged: Sequence[int], trusted: Sequence[int], support: Array
) -> list[Flag]:
    """Flag channels that follow another channel closely in every segment, but with changing sign or gain.

    Args:
        names: channels.
        lagged: lagged covariances of every segment.
        judged: columns that can be flagged.
        trusted: columns with which a channel is compared.
        support: largest correlation of each channel with a target over all segments, ``(channel,)``. If two untrusted
            channels disagree, the channel with less than half of the other's correlation is flagged.
    """
    squares = lagged.squares().astype(np.float64)
    usable = np.asarray((squares > 0).all(axis=0))

    def of_channel(i: int) -> Flag | None:
        if not usable[i]:
            return None
        scale = np.sqrt(squares[:, None, i, None] * squares[:, None, :])
        correlations: Array = np.divide(
            lagged.sums[:, :, i], scale, out=np.zeros(lagged.sums[:, :, i].shape), where=scale > 0
        )
        held_against = np.zeros(len(names), dtype=np.bool_)
        held_against[list(trusted)] = True
        held_against[list(judged)] = support[list(judged)] > 2.0 * support[i]
        correlations[:, :, ~(usable & held_against)] = 0.0
        correlations[:, :, i] = 0.0
        least: Array = np.abs(correlations).min(axis=0)
        lag, j = (int(k) for k in np.unravel_index(int(least.argmax()), least.shape))
        values = correlations[:, lag, j]
        turned = min(int(np.sum(values > 0)), int(np.sum(values < 0)))
        gains = np.abs(values) * np.sqrt(squares[:, i] / squares[:, j])
        changed = float(gains.max() / gains.min()) if least[lag, j] >= EXACT else 1.0
        if least[lag, j] < STRONG or (turned == 0 and changed < GAIN):
            return None
        what = (
            f"its sign differs in {turned} of {len(values)} pieces"
            if turned
            else f"its gain differs by a factor of {changed:.1f} among pieces"
        )
        text = f"follows {names[j]} in every piece (correlation {least[lag, j]:.2f} or more), but {what}"
        return Flag(names[i], FlagKind.ARTEFACT, names[j], lag - lagged.reach, float(least[lag, j]), text)

    return [flag for flag in spread(of_channel, judged) if flag is not None]


def flag_broken(
    table: CandidateTable, live: Sequence[int], judged: Sequence[int], trusted: Sequence[int]
) -> list[Flag]:
    """Flag channels that follow another with one gain in some recordings, but with another sign or not in others.

    A block may join recordings with different relations, so every segment is evaluated separately, at lag 0. Natural
    relations change their gain together with their sign or strength; a reversed or disconnected plug does not. A
    segment counts if the source moves enough for the gain and noise of the other segments to show the relation.

    Args:
        table: the data.
        live: columns of the table that change.
        judged: indices in `live` of the channels that can be flagged.
        trusted: indices in `live` of the reference channels. Between two untrusted channels, the broken one cannot be
            identified.
    """
    piece_moments = [_moments([stretch[:, live]]) for piece in table.pieces for stretch in piece.stretches]
    relations, slopes, squares = (np.array(values) for values in zip(*piece_moments, strict=True))
    flags = []
    for i in judged:
        sources = [j for j in trusted if j != i]
        verdicts = [(_find_break(relations[:, i, j], np.abs(slopes[:, i, j]), squares[:, [i, j]]), j) for j in sources]
        reported = [(*verdict, j) for verdict, j in verdicts if verdict is not None]
        if reported:
            value, text, j = max(reported)
            source = table.names[live[j]]
            flags.append(Flag(table.names[live[i]], FlagKind.ARTEFACT, source, 0, value, f"shows {source} {text}"))
    return flags


def _find_break(relation: Array, slope: Array, squares: Array) -> tuple[float, str] | None:
    """Return the mean correlation in segments with a relation, and a description of the break; None without a break.

    Args:
        relation: correlation of channel and source, ``(stretch,)``.
        slope: size of the channel's slope on the source, ``(stretch,)``.
        squares: variances of channel and source, ``(stretch, 2)``.
    """
    strong = np.abs(relation) >= STRONG
    count = int(strong.sum())
    if count < max(4, len(strong) // 5):
        return None
    low, high = np.quantile(slope[strong], (0.1, 0.9))
    turned = min(int((strong & (relation > 0)).sum()), int((strong & (relation < 0)).sum()))
    value = float(np.abs(relation[strong]).mean())
    if high <= STEADY * low and turned >= max(2, 0.2 * count):
        return (
            value,
            f"with one gain in {count} of {len(strong)} stretches, but with the other sign in {turned} of them",
        )
    noise = float(np.median((squares[:, 0] * (1.0 - relation**2))[strong]))
    shown = float(np.median(slope[strong])) ** 2 * squares[:, 1]
    # Expected correlation for this gain and noise and the source's variance in the segment.
    looked = np.sqrt(shown / np.maximum(shown + noise, 1e-300)) >= VISIBLE
    absent = int((looked & (np.abs(relation) <= ABSENT)).sum())
    if high <= SAME * low and absent >= max(2, 0.2 * looked.sum()):
        return value, f"with one gain in {count} stretches, but not at all in {absent} others where it moves as much"
    return None


def _moments(stretches: Sequence[np.ndarray]) -> tuple[Array, Array, Array]:
    """Return correlations ``[i, j]``, slopes of i on j (0 for constant channels) and variances ``(channel,)``."""
    count = sum(len(stretch) for stretch in stretches)
    mean = sum(stretch.sum(axis=0, dtype=np.float64) for stretch in stretches) / count
    products = np.zeros((len(mean), len(mean)))
    for part in chunks(stretches):
        # Subtract the means before the products, which would otherwise lose digits.
        part -= mean
        products += part.T @ part
    square = np.diag(products)
    moving = square > 1e-12 * count * np.maximum(mean * mean, 1e-30)
    both = np.outer(moving, moving)
    relation = np.divide(products, np.sqrt(np.outer(square, square)), out=np.zeros_like(products), where=both)
    slope = np.divide(products, square[None, :], out=np.zeros_like(products), where=both)
    return relation, slope, np.where(moving, square, 0.0) / count


def lonely(values: Array, chance: float) -> int | None:
    """Return the only segment with a strong correlation, given one value per segment.

    None if there is no such segment.
    """
    order = np.argsort(-np.abs(values))
    first, second = float(abs(values[order[0]])), float(abs(values[order[1]]))
    # The correlation must be strong absolutely, compared with the next segment, and compared with chance.
    return int(order[0]) if first > max(0.3, 4 * second, 3 * chance) else None
