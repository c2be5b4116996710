"""Rows for training an ensemble: inputs and targets of its members, and the left-out fold of each row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from edp.data.folds import Folds, make_block_folds, recording_folds
from edp.data.lags import DoubleArray
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import DataError
from edp.networks.committee import Committee
from edp.networks.predictor import Predictor
from edp.storage.memory import check_setting
from edp.training.bagging.spec import BaggingSpec
from edp.training.validation import standard_targets

PIECE = 4096
"""Ticks of a segment that go through the front end in one call."""
FLOAT, DOUBLE = 4, 8
PRESENT_BEYOND, CHANGE_BEYOND = 1.0, 10.0
"""How far beyond what trained a column may go, in ranges of it. A position or temperature that leaves its range by more
than all of it says little by a linear map; larger changes than recorded ones are often real, as in quicker motion
(journal: Sjoberg's arm, and an arm of which an axis moved for the first time)."""
FEW_LEVELS = 16
"""Levels of a channel up to which it and its changes are held at their range: an encoder of an axis that rests shows a
few steps of noise or drift; a line through them says nothing of the axis in motion (journal: one axis a log)."""


@dataclass(frozen=True, eq=False)
class BaggingTable:
    """Rows of all segments, concatenated.

    Attributes:
        columns: the committee's changes over several spans, ``(row, column)``, float32.
        targets: standardised, ``(row, output)``; outputs are horizons times targets.
        folds: who is left out when.
        stride: ticks from row to row.
        starts: first row of each segment, those of the training part first, and the tick that it stands for.
    """

    columns: NDArray[np.float32]
    targets: DoubleArray
    folds: Folds
    stride: int
    starts: tuple[tuple[int, int], ...]

    def predict_all(self, error: DoubleArray, truth: Sequence[DoubleArray]) -> list[DoubleArray]:
        """Return predictions at every sample of each segment, standardised ``(tick, output)``.

        Where rows were thinned out, the error of the row before a tick stands for that of the tick.

        Args:
            error: error of each row, prediction minus target, ``(row, output)``.
            truth: targets of each segment of the training part, then of the validation part.
        """
        rows = [
            first + np.maximum(0, np.arange(len(part)) - tick) // self.stride
            for (first, tick), part in zip(self.starts, truth, strict=True)
        ]
        return [part + error[chosen] for part, chosen in zip(truth, rows, strict=True)]


def committee_of(net: Predictor) -> Committee:
    """Return the backbone of an ensemble network.

    Raises:
        TypeError: it is another one; `check_training` refuses this before.
    """
    if not isinstance(net.backbone, Committee):
        raise TypeError("bagging trains a committee; check_training refuses any other backbone")
    return net.backbone


def table_of(net: Predictor, data: Prepared, spec: BaggingSpec) -> BaggingTable:
    """Return the rows of the training and validation parts as the network sees them.

    Its bank then gives changes of unit spread.

    Raises:
        ConfigError: more rows than the memory takes.
        DataError: no segment is longer than the largest horizon.
    """
    reach = data.task.max_horizon
    stretches = [part for part in (*data.train, *data.validation) if part.samples > reach]
    if not stretches:
        raise DataError(
            f"no stretch of the training and validation parts is longer than the largest horizon of {reach} ticks; "
            "give longer recordings"
        )
    bank = committee_of(net).bank
    ticks = [part.samples - reach for part in stretches]
    # A filter starts from nothing: derivatives and changes of a stretch's first ticks say what no later tick says. No
    # test looks at them either; of a short stretch most rows are still taken.
    skips = [min(net.spec.window - 1, count // 4) for count in ticks]
    stride = max(1, math.ceil((sum(ticks) - sum(skips)) / spec.max_rows))
    # Logs that begin alike, as filters settle, would all give the same ticks of it: the others would be told by none.
    firsts = [
        skip + number % min(stride, count - skip) for number, (skip, count) in enumerate(zip(skips, ticks, strict=True))
    ]
    chosen = [range(first, count, stride) for first, count in zip(firsts, ticks, strict=True)]
    outputs = len(data.task.horizons) * len(data.task.targets)
    rows = sum(map(len, chosen))
    check_setting(
        rows * (2 * FLOAT * bank.columns + 6 * DOUBLE * outputs),
        f"training: {rows:,} rows of {bank.columns:,} columns and {outputs:,} outputs",
        "make training.ensemble.max_rows smaller, or the backbone's lags fewer",
    )
    columns = np.concatenate([bank_rows(net, part, of) for part, of in zip(stretches, chosen, strict=True)])
    targets = np.concatenate(
        [
            standard_targets(net, part)[0].flatten(1).numpy()[list(of)]
            for part, of in zip(stretches, chosen, strict=True)
        ]
    )
    spread = columns[:, bank.width :].std(axis=0, dtype=np.float64)
    gain = np.where(spread > 0, 1.0 / np.where(spread > 0, spread, 1.0), 1.0).astype(np.float32)
    columns[:, bank.width :] *= gain
    still = torch.from_numpy(np.ptp(columns, axis=0) == 0)
    with torch.no_grad():
        bank.gain.copy_(torch.from_numpy(gain).view_as(bank.gain))
        if bank.bounded:
            bank.set_limits(*_limits(columns, bank.width))
        for group in committee_of(net).members:
            # No gradient reaches these weights: random ones would answer a channel that moves later for the first time.
            group.weights[0][:, still] = 0.0
    lengths = [len(of) for of in chosen]
    whole = _whole_recordings(stretches, data.test, lengths, spec.folds)
    starts = zip(np.cumsum([0, *lengths])[:-1].tolist(), firsts, strict=True)
    if whole is not None:
        return BaggingTable(columns, targets, whole, stride, tuple(starts))
    pieces = _pieces(rows / spec.folds, data.test, reach, stride)
    # Rows within the bank's reach and the largest horizon of a fold share samples with it. Beside pieces as short as
    # what tests there is the gap that lies beside that (`prepare`): wider ones would cost a third of what trains.
    gap = math.ceil(((net.spec.window if pieces > 1 else bank.reach) + reach) / stride)
    gap = min(gap, max(1, sum(lengths) // (4 * spec.folds * pieces)))
    return BaggingTable(columns, targets, make_block_folds(lengths, spec.folds, gap, pieces), stride, tuple(starts))


def _limits(columns: NDArray[np.float32], present: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the lower and upper limit of each column: its widened range; the first `present` columns are values."""
    low, high = columns.min(axis=0), columns.max(axis=0)
    share = np.where(np.arange(len(low)) < present, PRESENT_BEYOND, CHANGE_BEYOND)
    few = np.array([len(np.unique(columns[:, channel])) <= FEW_LEVELS for channel in range(present)])
    share[np.tile(few, len(low) // present)] = 0.0
    beyond = (share * (high - low)).astype(np.float32)
    return torch.from_numpy(low - beyond), torch.from_numpy(high + beyond)


def _whole_recordings(
    stretches: Sequence[Series], test: Sequence[Series], lengths: Sequence[int], folds: int
) -> Folds | None:
    """Return the folds of whole recordings where whole recordings test, of which no row trains.

    None where parts of them do.
    """
    names = [part.recording for part in stretches]
    if not test or not all(names) or not {part.recording for part in test}.isdisjoint({*names, ""}):
        return None
    return recording_folds(lengths, names, folds)


def _pieces(share: float, test: Sequence[Series], reach: int, stride: int) -> int:
    """Return the number of contiguous parts per fold that makes them as long as the test segments.

    What a fold leaves out should be as unlike the rest as what tests is: of three logs whose ends test a fold of one
    piece would leave out most of one log, and a model that does well on a log it has not seen would be preferred.
    """
    lengths = [part.samples - reach for part in test if part.samples > reach]
    return max(1, round(share * stride / float(np.median(lengths)))) if lengths else 1


def bank_rows(net: Predictor, part: Series, chosen: range | None = None) -> NDArray[np.float32]:
    """Return the bank features of a segment, as a stream from its first sample, ``(row, column)``.

    Args:
        net: network with a committee.
        part: the segment.
        chosen: rows that are wanted; all where it is None. Of a long segment all would fill the memory.
    """
    chosen_rows = range(part.samples) if chosen is None else chosen
    bank = committee_of(net).bank
    like = next(net.parameters())
    rows = []
    with torch.inference_mode():
        front, state = net.front.initial_state(1, like), bank.initial_state(1, like)
        for start in range(0, part.samples, PIECE):
            x = torch.from_numpy(part.inputs[start : start + PIECE]).unsqueeze(0).to(like)
            features, front = net.front(x, front)
            values, state = bank(net.front.scale(features), state)
            # The first wanted row of the piece; a copy, since a view would keep the whole piece.
            first = (
                start + (chosen_rows.start - start) % chosen_rows.step
                if start > chosen_rows.start
                else chosen_rows.start
            )
            within = slice(
                first - start, max(first, min(chosen_rows.stop, start + len(x[0]))) - start, chosen_rows.step
            )
            rows.append(values[0, within].float().numpy().copy())
    return np.concatenate(rows)
