"""A predictor and its adaptation as one stream."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from edp.models.predictor import Predictor
from edp.models.running import Stream
from edp.onboard import Adaptation, Adapter, Status


class AdaptedStream(Stream):
    """A stream whose predictions are corrected by what was learned on the way; see `edp.onboard.Adapter`.

    Intervals are those of the network; they move with its prediction if `correction` is added.

    Args:
        predictor: the network; it is put in evaluation mode.
        adaptation: how it is corrected.

    Attributes:
        adapter: what was learned; `adapter.learned` outlives a restart, `adapter.restore` brings it back.
        learn: False freezes what was learned.
        status: what the last step has done.
        correction: what it added ``(horizon, target)``, SI units.
    """

    def __init__(self, predictor: Predictor, adaptation: Adaptation) -> None:
        self.adapter, self.learn = Adapter(adaptation), True
        super().__init__(predictor)

    def reset(self) -> None:
        """Forget all ticks; what was learned stays. ``adapter.reset()`` forgets that."""
        super().reset()
        self.adapter.interrupt()
        self.status = Status.NONE
        self.correction = np.zeros_like(self.adapter.adaptation.unit)

    def step(self, inputs: Sequence[float] | NDArray[np.floating] | Tensor) -> NDArray[np.float32]:
        """Feed one tick ``(input,)`` in SI units; returns the corrected prediction ``(horizon, target)``, SI units."""
        base = super().step(inputs)
        adapted, self.status = self.adapter.step(np.asarray(inputs), base, fresh=self.warm, learn=self.learn)
        self.correction = adapted - base
        return adapted
