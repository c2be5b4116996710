"""Requirements on the logs of a target before a network of another machine is trained on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.data.chunks import ChunkSpec
from edp.data.prepared import Prepared
from edp.data.scaling import least_spread
from edp.data.series import Series
from edp.data.task import Task
from edp.errors import DataError, closest
from edp.networks.frontend import FrontEnd
from edp.recording import Recording
from edp.signals import KINDS, Kind
from edp.wording import typed

SEARCHED_S = 0.5
"""Longest lag from a pilot pressure to the motion that it commands."""
TOGETHER = 0.3
"""Correlation from which the direction of a motion counts as known."""
FAR = 100.0
"""How many times larger or smaller a channel may be than the source's; units differ by more, machines by less."""
CONVENTION = {
    ("BmUp", "CylVels_1"): 1,
    ("BmDwn", "CylVels_1"): -1,
    ("AmIn", "CylVels_2"): 1,
    ("AmOut", "CylVels_2"): -1,
    ("BktIn", "CylVels_3"): 1,
    ("BktOut", "CylVels_3"): -1,
}
"""Sign of the motion that a pilot pressure commands, in the built-in names (extension is positive)."""


class PilotPair(NamedTuple):
    """A pilot pressure and a target that follows it."""

    pilot: str
    target: str


def check_channels(recordings: Sequence[Recording], task: Task) -> None:
    """Refuse logs that lack a channel or have another rate, with all that is wrong at once.

    Raises:
        DataError: channels are missing or rates differ; the message names channels, logs and advice.
    """
    sources = {entry.name: entry.source for entry in task.derived}
    needed = dict.fromkeys([*task.inputs, *(sources.get(name, name) for name in task.targets)])
    problems = []
    for recording in recordings:
        missing = [name for name in needed if name not in recording.channel_names]
        if missing:
            hint = closest(missing[0], recording.channel_names) if len(missing) == 1 else ""
            problems.append(f"'{recording.name}' ({recording.source}) lacks {', '.join(missing)}{hint}")
    if problems:
        raise DataError(
            "the network reads channels that the logs do not have:\n  - " + "\n  - ".join(problems) + "\n  - "
            "map the columns that hold them (--map); give a channel that this machine does not have a value there "
            "(constant = 0.0); or train the source without it (task.features)"
        )
    # A thousandth: rates from time stamps are never exact.
    other = [
        f"'{r.name}' {typed(r.rate_hz)} Hz" for r in recordings if abs(r.rate_hz - task.rate_hz) > 1e-3 * task.rate_hz
    ]
    if other:
        raise DataError(
            f"the network runs at {typed(task.rate_hz)} Hz, the logs have another rate: {', '.join(other)}; set "
            "rate_hz = "
            f"{typed(task.rate_hz)} in the signal map (--map) to resample them, or train the source at the rate of "
            "the logs"
        )


def check_lengths(data: Prepared, chunks: ChunkSpec, window: int) -> None:
    """Refuse logs whose parts are shorter than a start-up and the horizon.

    Raises:
        DataError: parts are too short; the message names them and the minimum length of the shortest log.
    """
    # The longest start-up of the regime, so that at least one tick is left to learn from.
    lead = max(window, chunks.burn_in if chunks.regime == "chunk" else chunks.length + chunks.consecutive - 2)
    needed = lead + data.task.max_horizon + 1
    rate = data.task.rate_hz
    short = [
        f"{part} '{series.name}' {series.samples / rate:.1f} s"
        for part in ("train", "validation", "test")
        for series in getattr(data, part)
        if series.samples < needed
    ]
    if short:
        raise DataError(
            f"logs are too short: each part of each log needs {needed / rate:.2f} s (start-up of {lead} ticks and "
            f"horizon of {data.task.max_horizon}), but there are {'; '.join(short)}. Leave these logs out, join them, "
            "or give validation and test larger shares (--set split.validation_fraction=0.2)"
        )


def check_moving(data: Prepared) -> None:
    """Refuse targets that do not move in the training or test part.

    Raises:
        DataError: targets do not move; the message names them.
    """
    for part in ("train", "test"):
        values = np.concatenate([series.targets for series in getattr(data, part)]).astype(np.float64)
        still = [
            f"{name} is {typed(mean)} throughout"
            for name, kind, mean, std, largest in zip(
                data.task.targets,
                data.target_kinds,
                values.mean(axis=0),
                values.std(axis=0),
                np.abs(values).max(axis=0),
                strict=True,
            )
            if std <= least_spread(kind, largest)
        ]
        if still:
            raise DataError(
                f"{'; '.join(still)} in the {part} part of the logs: nothing can be learned or judged of a target "
                "that does not move. Look for a frozen sensor or a wrong column with edp data check, or give logs in "
                "which every target moves"
            )


def check_units(data: Prepared, scaler: FrontEnd) -> None:
    """Refuse logs with channels that are hundreds of times as large, or as small, as the source's.

    A machine that rests is no wrong unit: smallness counts only where all channels of a kind, two or more, have it.

    Args:
        data: data of the target.
        scaler: scaler of the source, with centre and spread of each channel.

    Raises:
        DataError: magnitudes differ; the message names channels, both magnitudes and advice.
    """
    names = data.task.features.channels
    offset, width = (values[: len(names)].detach().double().cpu().numpy() for values in (scaler.offset, scaler.width))
    # Two widths beyond the offset hold nearly all that the source has seen.
    there = np.abs(offset) + 2.0 * width
    logged = np.concatenate([np.abs(part.inputs[:, : len(names)]) for part in data.train])
    # The 99 % quantile: single spikes must not look like another unit.
    here = np.quantile(logged, 0.99, axis=0).astype(np.float64)
    wrong = here > FAR * there
    kinds = np.array([channel.kind for channel in data.inputs[: len(names)]])
    # A kind that is too small as a whole is in another unit; a single quiet channel may just rest.
    for kind in dict.fromkeys(kinds):
        same = (kinds == kind) & (here > 0.0)
        if same.sum() >= 2 and (here[same] * FAR < there[same]).all():
            wrong |= same
    if wrong.any():
        differences = "; ".join(
            f"{names[i]} up to {typed(here[i], 3)}, in the source about {typed(there[i], 3)} "
            f"{KINDS[data.inputs[i].kind].si_unit}"
            for i in np.flatnonzero(wrong)
        )
        raise DataError(
            f"channels of the logs are more than {typed(FAR)} times as large or as small as those that the network "
            "learned "
            f'from: {differences}. Say the unit of these columns in the signal map (--map), such as unit = "bar"'
        )


def check_signs(data: Prepared, source: Prepared | None) -> list[str]:
    """Refuse logs in which targets move against the pilot pressures that moved them in the source.

    Args:
        data: data of the target.
        source: data of the source; None to compare with the sign convention of the built-in names.

    Returns:
        What could not be found out, in sentences.

    Raises:
        DataError: targets move in the opposite direction; the message names them and the advice.
    """
    pairs = list(_pairs(data))
    if not pairs:
        return ["The sign convention of the logs was not checked: the network reads no pilot pressure."]
    own = {pair: correlation(data, data.train, pair) for pair in pairs}
    usual = {pair: float(CONVENTION[pair]) for pair in pairs if tuple(pair) in CONVENTION}
    source_correlations = usual if source is None else {pair: correlation(source, source.train, pair) for pair in pairs}
    # Both correlations must be clear: a weak one has its sign by chance.
    sure = {p: (r, own[p]) for p, r in source_correlations.items() if min(abs(r), abs(own[p])) >= TOGETHER}
    turned = {pair: both for pair, both in sure.items() if both[0] * both[1] < 0}
    if turned:
        origin = "by convention" if source is None else "in the source"
        differences = "; ".join(
            f"{p.target} after {p.pilot}: {'positive' if r > 0 else 'negative'} {origin}, correlation {own:+.2f} here"
            for p, (r, own) in turned.items()
        )
        raise DataError(
            f"the logs have another sign convention than the source: {differences}. Turn the column in the signal map "
            "(scale = -1.0), or exchange the two pilot pressures if they are mixed up; "
            "finetune.check_signs = false takes the logs as they are"
        )
    blind = [t for t in data.task.targets if not any(p.target == t for p in sure)]
    if blind:
        return [
            f"The sign of {', '.join(blind)} was not checked: no pilot pressure moves with it clearly (correlation of "
            f"{typed(TOGETHER)} or more within {typed(SEARCHED_S)} s) in both the source and the logs."
        ]
    return []


def _pairs(data: Prepared) -> Iterator[PilotPair]:
    pilots = [channel.name for channel in data.inputs if channel.kind is Kind.PILOT_PRESSURE]
    speeds = [n for n, kind in zip(data.task.targets, data.target_kinds, strict=True) if kind is Kind.VELOCITY]
    return (PilotPair(pilot, target) for target in speeds for pilot in pilots)


def correlation(data: Prepared, parts: Sequence[Series], pair: PilotPair) -> float:
    """Return Pearson's correlation of a pilot pressure with a target, at the lag with the largest correlation."""
    column, target = data.task.inputs.index(pair.pilot), data.task.targets.index(pair.target)
    reach = round(SEARCHED_S * data.task.rate_hz)
    pilot = [part.inputs[:, column].astype(np.float64) for part in parts]
    moved = [part.targets[:, target].astype(np.float64) for part in parts]
    # Ten lags suffice: pressures and motions are smooth over 50 ms.
    correlations = [_pearson(pilot, moved, lag) for lag in range(0, reach + 1, max(1, reach // 10))]
    return max(correlations, key=abs)


Values = Sequence[NDArray[np.float64]]


def _pearson(first: Values, second: Values, lag: int) -> float:
    """Return the correlation of ``first[t]`` and ``second[t + lag]``; 0 if one is constant."""
    a = np.concatenate([part[: max(0, len(part) - lag)] for part in first])
    b = np.concatenate([part[lag:] for part in second])
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0
