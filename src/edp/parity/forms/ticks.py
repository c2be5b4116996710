"""PyTorch itself, tick by tick: the stream as on the machine against the stream in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from edp.export.golden import Rows
from edp.models.running import Stream
from edp.parity.base import FORMS, Case, Ran, timed


@FORMS.register("torch_ticks")
class TorchTicks:
    """`edp.models.running.Stream`."""

    title: ClassVar[str] = "PyTorch, tick by tick"

    def run(self, case: Case, folder: Path) -> Sequence[tuple[str, Ran]]:
        """See `edp.parity.base.Form`."""
        predictor = case.bundle.predictor
        running, coverages = Stream(predictor), predictor.output.coverages

        def ticks() -> Rows:
            running.reset()
            return np.array([running.step(row).ravel() for row in case.inputs], dtype=np.float32)

        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # a tick is too small to be shared out
        try:
            found, seconds = timed(ticks)
        finally:
            torch.set_num_threads(threads)
        numbers = found.shape[1]
        note = "bounds of intervals are not among them" if coverages else ""
        return [("", Ran(found, seconds / len(found), case.wanted[:, :numbers], case.allowed[:numbers], note))]
