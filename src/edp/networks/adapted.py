"""A predictor and its adaptation as one stream."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edp.ir.rls import Adaptation, RlsCorrector, RlsStatus
from edp.networks.predictor import Predictor
from edp.networks.stream import Inputs, Stream, StreamStatus, StreamTick


class AdaptedStream(Stream):
    """Stream whose predictions are corrected online by recursive least squares; see `edp.ir.rls.RlsCorrector`.

    The correction does not learn from held and missed samples, but their predictions are corrected, as in the exported
    C code. Interval bounds are shifted with the prediction.

    Args:
        predictor: the network; it is put in evaluation mode.
        adaptation: settings of the correction.
        threads: see `Stream`.

    Attributes:
        adapter: learned correction; `adapter.learned` is saved across a restart, `adapter.restore` loads it.
        learn: whether the correction continues to learn; False keeps the learned correction constant.
        status: status of the adaptation in the last step.
        correction: added correction ``(horizon, target)``, SI units.
    """

    def __init__(self, predictor: Predictor, adaptation: Adaptation, threads: int = 1) -> None:
        self.adapter, self.learn = RlsCorrector(adaptation), True
        super().__init__(predictor, threads)

    def reset(self) -> None:
        """Reset the state of the network; the learned correction remains. ``adapter.reset()`` resets the correction."""
        super().reset()
        # The change across a reset is not a motion of the machine, so the correction must not learn from it.
        self.adapter.interrupt()
        self.status = RlsStatus.NONE
        self.correction = np.zeros_like(self.adapter.adaptation.unit)
        self._corrected: StreamTick | None = None

    def step(self, inputs: Inputs) -> StreamTick:
        """Feed one tick ``(input,)`` in SI units; the prediction is the corrected one."""
        return self._correct(super().step(inputs))

    def missed(self, ticks: int = 1) -> StreamTick:
        """Report missing samples without a step; the returned prediction is corrected."""
        result = super().missed(ticks)
        self.adapter.interrupt()
        return self._correct(result)

    def _correct(self, base: StreamTick) -> StreamTick:
        if not base.valid:
            # No prediction to correct: the last corrected one stays, as the output of the exported C does.
            self.adapter.interrupt()
            self.status = RlsStatus.NONE
            prediction = base if self._corrected is None else self._corrected
            return replace(prediction, status=base.status)
        # Only a tick with accepted inputs of its own carries new information; held inputs would be learned twice.
        fresh = base.status is StreamStatus.OK
        adapted, self.status = self.adapter.step(self._last, base.prediction, fresh=fresh, learn=self.learn)
        self.correction = adapted - base.prediction
        # Bounds move with the centre: the correction shifts the prediction and says nothing about its spread.
        lower, upper = base.lower + self.correction, base.upper + self.correction
        self._corrected = replace(base, prediction=adapted, lower=lower, upper=upper)
        return self._corrected
