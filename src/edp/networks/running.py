"""Run a predictor over whole recordings, as a stream, several side by side, or window by window."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.networks.losses import Prediction
from edp.networks.predictor import Predictor
from edp.networks.streaming import State

A = TypeVar("A")
Run = Callable[[Tensor, State], tuple[Tensor, State]]
MAX_TICKS_TOGETHER = 1 << 22  # of streams side by side whose answers are in memory: 11 hours at 100 Hz
PIECE = 512  # ticks per call, or windows: long enough for speed, short enough for memory


def stream_predictions(predictor: Predictor, series: Sequence[Series], batch: int = 16) -> list[NDArray[np.float32]]:
    """Return the predictions for every tick of every series, each from reset, state carried to its end.

    Returns:
        For each series float32 ``(time, horizon, target)`` in SI units: row t is the prediction made at t.
    """
    return _stream(predictor, predictor.predict, series, batch)


def window_predictions(predictor: Predictor, series: Sequence[Series]) -> list[NDArray[np.float32]]:
    """Return predictions, each from a reset over the window that ends at its sample (thesis 3.1.4).

    The cost is W times that of a stream. The first samples use the available part of their window.
    """
    return _windows(predictor, predictor.predict, series)


def mean_error(predictor: Predictor, series: Sequence[Series]) -> float:
    """Return the mean absolute error over series, horizons and targets, SI units.

    Each series from reset, after a whole window.

    Not a number where no series is longer than that.
    """
    errors = [np.abs(error).mean(axis=0) for _, error in stream_errors(predictor, series)]
    return float(np.mean(errors)) if errors else math.nan


def stream_errors(predictor: Predictor, series: Sequence[Series]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Place of a horizon and errors ``(time, target)`` in SI units; each series from reset, after a whole window.

    Series that are no longer than window and horizon are passed over.
    """
    # A whole window from reset: before that, predictions suffer from the start and not from the network.
    skip = predictor.spec.window
    for predicted, part in zip(stream_predictions(predictor, series), series, strict=True):
        for horizon_index, k in enumerate(predictor.task.horizons):
            if part.samples > skip + k:
                yield horizon_index, predicted[skip : part.samples - k, horizon_index] - part.targets[skip + k :]


def stream_intervals(predictor: Predictor, series: Sequence[Series], batch: int = 16) -> list[NDArray[np.float32]]:
    """Return the interval bounds for every tick of every series, each from reset.

    Returns:
        For each series float32 ``(time, coverage, 2, horizon, target)`` in SI units, lower then upper, in the order of
        ``predictor.spec.output.coverages``.
    """
    return _stream(predictor, predictor.intervals, series, batch)


def stream_answers(
    predictor: Predictor, series: Sequence[Series], batch: int = 16, windowed: bool = False
) -> list[Prediction]:
    """Return all standardised outputs at every sample, with a batch of size 1, in double precision on the CPU.

    Args:
        predictor: the network.
        series: each from reset.
        batch: streams side by side.
        windowed: each answer from reset over the window that ends at its tick, and not as a stream.
    """
    form: list[Prediction] = []

    def run(x: Tensor, state: State) -> tuple[Tensor, State]:
        answer, _, new = predictor.run(x, state)
        form[:] = [answer]
        return torch.cat([answer.center.unsqueeze(-2), answer.spread], dim=-2), new

    answers = _windows(predictor, run, series) if windowed else _stream(predictor, run, series, batch)
    values = [torch.from_numpy(series_answer).double().unsqueeze(0) for series_answer in answers]
    levels, law = (form[0].levels, form[0].law) if form else ((), "")
    return [Prediction(every[..., 0, :], every[..., 1:, :], levels, law) for every in values]


def stream_hidden(predictor: Predictor, series: Sequence[Series], batch: int = 4) -> list[NDArray[np.float32]]:
    """Return the backbone's representation at every sample of each series, float32 ``(time, width)``, from a reset."""

    def run(x: Tensor, state: State) -> tuple[Tensor, State]:
        _, _, hidden, new = predictor.forward_features(x, state)
        return hidden, new

    return _stream(predictor, run, series, batch)


def _stream(predictor: Predictor, run: Run, series: Sequence[Series], batch: int) -> list[NDArray[np.float32]]:
    results = dict(streamed(predictor, run, series, batch))
    return [results[i] for i in range(len(series))]


def streamed(
    predictor: Predictor,
    run: Run,
    series: Sequence[Series],
    batch: int = 16,
    groups: Sequence[Sequence[int]] | None = None,
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield the index of each series and the results of `run` at every sample, ``(time, ...)``.

    Shorter series come first.

    Args:
        predictor: the network, which is in the state of evaluation until the last series was given.
        run: a method of it, such as ``predictor.predict``.
        series: each from reset, state carried to its end.
        batch: streams side by side; fewer where they are so long that their answers would fill the memory.
        groups: some of `stream_groups`, where not all series are to be run.
    """
    with _evaluating(predictor):
        for group in stream_groups(series, batch) if groups is None else groups:
            yield from zip(group, _run_group(predictor, run, [series[i] for i in group]), strict=True)


def stream_groups(series: Sequence[Series], batch: int = 16) -> list[list[int]]:
    """Return groups of series indices whose streams run in parallel, sorted by length.

    The last bits of an output can depend on the other streams of its batch; fixed groups make the bits reproducible.
    """
    # Streams of like length run together, so that little is computed beyond the end of the shorter ones.
    order = sorted(range(len(series)), key=lambda i: series[i].samples)
    groups, at = [], 0
    while at < len(order):
        longest = max(1, series[order[min(at + batch, len(order)) - 1]].samples)
        groups.append(order[at : at + max(1, min(batch, MAX_TICKS_TOGETHER // longest))])
        at += len(groups[-1])
    return groups


@contextmanager
def _evaluating(predictor: Predictor) -> Iterator[None]:
    was_training = predictor.training
    # Switch dropout off, so that predictions do not depend on the number of calls.
    predictor.eval()
    try:
        yield
    finally:
        predictor.train(was_training)  # back to what the caller had


def _windows(predictor: Predictor, run: Run, series: Sequence[Series]) -> list[NDArray[np.float32]]:
    like, window = next(predictor.parameters()), predictor.spec.window
    was_training = predictor.training
    predictor.eval()

    def answers(x: NDArray[np.float32]) -> NDArray[np.float32]:
        tensor = torch.from_numpy(np.ascontiguousarray(x)).to(device=like.device, dtype=like.dtype)
        predictions: NDArray[np.float32] = run(tensor, predictor.initial_state(len(x), like))[0].float().cpu().numpy()
        return predictions

    batches = []
    try:
        with torch.inference_mode():
            for part in series:
                # Ticks before the first whole window come from one stream from reset, as there is no shorter window.
                pieces = [answers(part.inputs[None, : window - 1])[0]] if window > 1 else []
                ends = np.arange(window, part.samples + 1)
                for at in range(0, len(ends), PIECE):
                    rows = ends[at : at + PIECE, None] - window + np.arange(window)
                    pieces.append(answers(part.inputs[rows])[:, -1])
                batches.append(np.concatenate(pieces)[: part.samples])
    finally:
        predictor.train(was_training)
    return batches


def _run_group(predictor: Predictor, run: Run, group: list[Series]) -> list[NDArray[np.float32]]:
    out: list[list[NDArray[np.float32]]] = [[] for _ in group]

    def numbers(x: Tensor, state: State) -> tuple[NDArray[np.float32], State]:
        y, new = run(x, state)
        return y.float().cpu().numpy(), new

    for start, values in _pieces(predictor, numbers, group):
        for i, part in enumerate(group):
            if start < part.samples:
                out[i].append(values[i, : part.samples - start])
    return [np.concatenate(pieces) for pieces in out]


def _pieces(
    predictor: Predictor, run: Callable[[Tensor, State], tuple[A, State]], group: Sequence[Series]
) -> Iterator[tuple[int, A]]:
    """Yield the first sample and the results of `run` for each segment of parallel streams, with carried state."""
    longest = max(part.samples for part in group)
    like = next(predictor.parameters())
    state = predictor.initial_state(len(group), like)
    for start in range(0, longest, PIECE):
        rows = np.arange(start, min(start + PIECE, longest))
        # A shorter stream repeats its last sample; the caller omits the outputs of these samples.
        x = np.stack([part.inputs[np.minimum(rows, part.samples - 1)] for part in group])
        # Inside the loop: a mode that a generator enters would stay on between its values.
        with torch.inference_mode():
            y, state = run(torch.from_numpy(x).to(device=like.device, dtype=like.dtype), state)
        yield start, y


def answer_pieces(
    predictor: Predictor, series: Sequence[Series], batch: int = 16
) -> Iterator[tuple[int, int, Prediction, Tensor]]:
    """Yield the network output of each series segment by segment, so that long outputs need not fit into memory.

    Returns:
        index of the series, first sample of the segment, network output, and the features of the output ``(1, tick,
        feature)``. Segments of a series are in order; series of similar length run in parallel.
    """
    order = sorted(range(len(series)), key=lambda i: series[i].samples)

    def run(x: Tensor, state: State) -> tuple[tuple[Prediction, Tensor], State]:
        answer, features, new = predictor.run(x, state)
        return (answer, features), new

    with _evaluating(predictor):
        for at in range(0, len(order), batch):
            group = order[at : at + batch]
            for start, (answer, features) in _pieces(predictor, run, [series[i] for i in group]):
                for lane, i in enumerate(group):
                    ticks = slice(0, max(0, series[i].samples - start))
                    center, spread = (part[lane : lane + 1, ticks] for part in (answer.center, answer.spread))
                    if center.shape[1]:
                        piece_answer = replace(answer, center=center, spread=spread)
                        yield i, start, piece_answer, features[lane : lane + 1, ticks]
