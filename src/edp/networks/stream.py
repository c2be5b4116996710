"""A predictor run tick by tick, under the rules of the exported C: validity, hold, missed ticks, warm-up, restart."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.errors import ConfigError, DataError
from edp.networks.input_range import HOLD_TICKS, input_limits
from edp.networks.predictor import Predictor
from edp.networks.streaming import State
from edp.wording import typed

Rows = NDArray[np.float32]
Inputs = Sequence[float] | NDArray[np.floating] | Tensor


class StreamStatus(IntEnum):
    """Result code of a stream step, with the values of `edp_status` in the exported C."""

    OK = 0
    """Status of a prediction from the inputs of the current sample."""
    WARMING = 1
    """Status after a reset, before a whole window of samples was read. The predictions are less accurate."""
    HELD = 2
    """Status of a prediction from the last accepted inputs, because the current inputs were rejected or missed."""
    RESTARTED = 3
    """Status without a new prediction: the memory was cleared, because the last inputs are too old or a result was not
    finite."""


@dataclass(frozen=True, eq=False)
class StreamTick:
    """Result of one stream step.

    Attributes:
        prediction: ``(horizon, target)``, float32, SI units. After `RESTARTED` the last valid one, as in C, where the
            output is left as it was; NaN before the first.
        lower: bounds of intervals ``(coverage, horizon, target)``, SI units; no rows where the network has none.
        upper: upper bounds, same shape.
        coverages: coverages of the intervals, in the order of their rows.
        status: status of the step.
    """

    prediction: Rows
    lower: Rows
    upper: Rows
    coverages: tuple[float, ...]
    status: StreamStatus

    @property
    def valid(self) -> bool:
        """Whether the prediction is of this tick; False after a restart."""
        return self.status is not StreamStatus.RESTARTED

    def interval(self, coverage: float) -> tuple[Rows, Rows]:
        """Lower and upper bounds ``(horizon, target)`` of an interval in SI units.

        Raises:
            ConfigError: the network has no interval of this coverage.
        """
        for row, own_coverage in enumerate(self.coverages):
            if math.isclose(own_coverage, coverage, abs_tol=1e-6):
                return self.lower[row], self.upper[row]
        known_text = ", ".join(typed(own_coverage) for own_coverage in self.coverages) or "none: its output is a point"
        raise ConfigError(f"no interval of coverage {typed(coverage)}; this network has {known_text}")


class Stream:
    """Predictor run sample by sample, as on the machine: one row of SI inputs gives predictions, intervals and flags.

    The rules equal the rules of the exported C code (docs/howto/deploy_c.md). A row with a NaN, an infinite value or a
    value beyond a million standard widths is rejected and counted; the network then repeats the last accepted row.
    After `HOLD_TICKS` rejected rows in sequence the memory is reset, and the next accepted row starts a new sequence.

    Args:
        predictor: the network; it is put in evaluation mode.
        threads: number of PyTorch threads during a step; a step is too small to be divided.

    Attributes:
        ticks: steps and held ticks since the last reset.
        rejected: inputs that were not accepted since then.
        held: ticks fed with the last accepted inputs since then.
        restarts: times since then that the memory was cleared because nothing could be held or a result was not finite.

    Raises:
        ConfigError: `threads` is below 1.
    """

    def __init__(self, predictor: Predictor, threads: int = 1) -> None:
        if threads < 1:
            raise ConfigError(f"a stream on {threads} threads was asked for; give at least 1")
        self.predictor, self._threads = predictor.eval(), threads  # evaluation: no dropout on a machine
        self._like = predictor.front.offset
        self._dtype = np.float64 if self._like.dtype is torch.float64 else np.float32
        # In single precision, as the exported code compares.
        self._low, self._high = (limit.astype(np.float32) for limit in input_limits(predictor))
        task, self._coverages = predictor.task, tuple(predictor.output.coverages)
        self._shape = (len(task.horizons), len(task.targets))
        self._state: State
        self._age: int
        self.reset()

    def reset(self) -> None:
        """Forget all ticks and counts."""
        self.ticks = self.rejected = self.held = self.restarts = 0
        self._last: NDArray[np.floating] = np.zeros(len(self.predictor.task.inputs), dtype=self._dtype)
        # NaN until the first tick: a zero could be taken for a prediction.
        self._numbers = np.full((1 + 2 * len(self._coverages), *self._shape), np.nan, dtype=np.float32)
        self._forget()

    @property
    def warm(self) -> bool:
        """True once a whole window has been seen since the memory was cleared."""
        return self._age >= self.predictor.window

    def step(self, inputs: Inputs) -> StreamTick:
        """Feed one tick ``(input,)`` in SI units, in the order of the network's inputs.

        Raises:
            DataError: another number of inputs, or something else than numbers.
        """
        row = self._row(inputs)
        if self.accepts(row):
            self._last, self._holding = row, 0
            return self._tick(self._run(holding=False))
        self.rejected += 1
        return self._tick(self._hold())

    def accepts(self, rows: NDArray[np.floating]) -> bool:
        """Return whether all inputs in SI units are accepted; shape (input,) or (ticks, input)."""
        # A value beyond float32 becomes infinite, and is rejected as such; a comparison with NaN is false.
        with np.errstate(over="ignore"):
            single = rows.astype(np.float32)
        inside: NDArray[np.bool_] = (single >= self._low) & (single <= self._high)
        return bool(inside.all())

    def steps(self, inputs: NDArray[np.floating]) -> list[StreamTick]:
        """Process consecutive samples, ``(ticks, input)``, with the results of `step` for each, up to rounding.

        Where all are accepted it is one call of the network, which costs little more than one tick.

        Raises:
            DataError: see `step`.
        """
        rows = [self._row(row) for row in inputs]
        if len(rows) < 2 or not self.accepts(np.array(rows)):
            return [self.step(row) for row in rows]
        before = self._state
        numbers = self._compute_rows(np.array(rows))
        if not np.isfinite(numbers).all():
            self._state = before
            return [self.step(row) for row in rows]
        ticks = []
        for row, self._numbers in zip(rows, numbers, strict=True):
            self.ticks += 1
            self._last, self._holding = row, 0
            self._age = min(self._age + 1, self.predictor.window)
            ticks.append(self._tick(StreamStatus.OK if self.warm else StreamStatus.WARMING))
        return ticks

    def missed(self, ticks: int = 1) -> StreamTick:
        """Report samples that passed without a step; return the result of the last missed sample.

        A gap that ends in a restart leaves the prediction as it was before the gap.

        Raises:
            DataError: `ticks` is below 1.
        """
        if ticks < 1:
            raise DataError(f"{ticks} missed ticks were reported; give at least 1")
        if ticks > HOLD_TICKS:
            # The gap exceeds the holding time, so the memory is cleared at once.
            self._holding = HOLD_TICKS
            self.ticks += ticks - 1
            return self._tick(self._hold())
        # Numbers of a tick that ended in a restart are no prediction; the last good ones stay.
        before = self._numbers
        for _ in range(ticks):
            status = self._hold()
        if status is StreamStatus.RESTARTED:
            self._numbers = before
        return self._tick(status)

    def _row(self, inputs: Inputs) -> NDArray[np.floating]:
        input_names = self.predictor.task.inputs
        values = inputs.detach().cpu().numpy() if isinstance(inputs, Tensor) else inputs
        try:
            with np.errstate(over="ignore"):
                row: NDArray[np.floating] = np.array(values, dtype=np.float64).astype(self._dtype)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"a tick of a stream takes {len(input_names)} numbers ({', '.join(input_names)}): {error}"
            ) from error
        if row.shape != (len(input_names),):
            raise DataError(
                f"a tick of a stream has shape {row.shape}; ({len(input_names)},) must hold, in this order: "
                f"{', '.join(input_names)}"
            )
        return row

    def _forget(self) -> None:
        """Clear the network's memory; counts and the last prediction stay."""
        self._age = self._holding = 0
        self._state = self.predictor.initial_state(1, self._like)

    def _run(self, holding: bool) -> StreamStatus:
        """Return one tick of the network from the last accepted inputs."""
        self.ticks += 1
        # Non-finite results would stay in the recurrent state for ever; clearing it is the only way back.
        numbers = self._compute_rows(self._last[None])[0]
        if not np.isfinite(numbers).all():
            self.restarts += 1
            self._forget()
            return StreamStatus.RESTARTED
        self._numbers = numbers
        self._age = min(self._age + 1, self.predictor.window)
        if holding:
            return StreamStatus.HELD
        return StreamStatus.OK if self.warm else StreamStatus.WARMING

    def _compute_rows(self, rows: NDArray[np.floating]) -> Rows:
        """Return predictions, then lower and upper bounds, ``(ticks, 1 + 2 * coverage, horizon, target)``, SI units."""
        x = torch.from_numpy(rows).to(dtype=self._like.dtype, device=self._like.device).unsqueeze(0)
        with torch.inference_mode(), _threads(self._threads):
            center, bounds, self._state = self.predictor.predict_with_intervals(x, self._state)
            parts = [center[0].unsqueeze(1)]
            parts += [] if bounds is None else [bounds[0, :, :, side] for side in (0, 1)]
            numbers: Rows = torch.cat(parts, dim=1).float().cpu().numpy()
        return numbers

    def _hold(self) -> StreamStatus:
        """Process a sample without new inputs."""
        # A stream without a sample since its reset has no inputs to hold.
        if self._age > 0 and self._holding < HOLD_TICKS:
            self._holding += 1
            self.held += 1
            return self._run(holding=True)
        self.ticks += 1
        if self._age > 0:
            self.restarts += 1
            self._forget()
        return StreamStatus.RESTARTED

    def _tick(self, status: StreamStatus) -> StreamTick:
        # Return a copy, because the caller may keep results while the stream continues.
        count = len(self._coverages)
        center, lower, upper = np.split(self._numbers.copy(), [1, 1 + count])
        return StreamTick(center[0], lower, upper, self._coverages, status)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Set PyTorch's number of threads inside the block, and restore the caller's afterwards."""
    before = torch.get_num_threads()
    # Setting the thread count costs a call into the thread pool at every tick; equal counts skip it.
    if before == count:
        yield
        return
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
