"""PyTorch sample by sample against PyTorch over the whole recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from edp.export.golden import Rows
from edp.networks.stream import Stream, StreamTick
from edp.workflows.parity.base import FORMS, ParityCase, Ran, timed


@FORMS.register("torch_ticks")
class TorchTicks:
    """`edp.networks.stream.Stream`."""

    title: ClassVar[str] = "PyTorch, tick by tick"

    def run(self, case: ParityCase, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.workflows.parity.base.Form`."""
        running = Stream(case.bundle.predictor)

        def ticks() -> Rows:
            running.reset()
            return np.array([_numbers(running.step(row)) for row in case.inputs], dtype=np.float32)

        predictions, seconds = timed(ticks)
        return [("", Ran(predictions, seconds / len(predictions)))]


def _numbers(tick: StreamTick) -> Rows:
    """Return the predictions, then lower and upper bounds, in the order of `edp.export.golden.stream`."""
    return np.concatenate([tick.prediction.ravel(), tick.lower.ravel(), tick.upper.ravel()])
