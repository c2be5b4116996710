"""Predictions of recordings, moved by a grey box that follows the machine."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.derived_velocities import matched
from edp.data.oil import oil_celsius
from edp.data.task import Task
from edp.errors import BundleError, ConfigError, DataError
from edp.ir.rls import Adaptation
from edp.networks.twin import Twin
from edp.networks.twin.adaptive_correction import TunedCorrection
from edp.networks.twin.adaptive_twin import HOTTEST_C, AdaptiveTwin, TunedSpec
from edp.recording import Recording
from edp.training.twin_bundle import OIL_C, TwinBundle
from edp.wording import typed

Rows = NDArray[np.float32]


def choose_tuned_spec(bundle: TwinBundle) -> TunedSpec:
    """Return which parameters of a twin adapt; oil temperature is known if the logs contain it.

    Raises:
        BundleError: its provenance holds another thing than a temperature there.
    """
    celsius = bundle.provenance.more.get(OIL_C, math.nan)
    if isinstance(celsius, bool) or not isinstance(celsius, int | float) or abs(celsius) > HOTTEST_C:
        raise BundleError(
            f"the twin's provenance holds {OIL_C} = {str(celsius)[:40]!r}, which is no temperature of oil"
        )
    return TunedSpec(oil_c=float(celsius))


def correction_of(twin: Twin, adaptation: Adaptation, task: Task, spec: TunedSpec | None = None) -> TunedCorrection:
    """Return the correction of a network's predictions by forecasts of a grey box that adapts to the machine.

    Args:
        twin: a grey box of the machine as it was.
        adaptation: adaptation of the network. It defines the horizons, and by its units what a large correction is.
        task: task of the network.
        spec: settings of the parameter adaptation.

    Raises:
        ConfigError: another rate than the network's, no grey box, or a target that is no velocity of it.
    """
    if twin.channels.rate_hz != task.rate_hz:
        raise ConfigError(
            f"the twin has {typed(twin.channels.rate_hz)} Hz, the network {typed(task.rate_hz)} Hz; train a twin at "
            "the "
            "network's rate"
        )
    limit = adaptation.spec.limit * adaptation.unit.astype(np.float64)
    return TunedCorrection(AdaptiveTwin(twin, spec), task.targets, adaptation.horizons, limit)


class TwinMoves:
    """Recordings of one machine through a `TunedCorrection`, one after the other.

    Where a recording and the logs of the twin tell the temperature of the oil, the numbers follow it at once.

    Args:
        twin: a grey box of the machine as it was.
        correction: correction of the network's predictions (`correction_of`).
    """

    def __init__(self, twin: Twin, correction: TunedCorrection) -> None:
        self._twin, self.correction = twin, correction

    def __call__(
        self, recordings: Sequence[Recording], predictions: Sequence[Rows], carry: bool, learn: bool
    ) -> list[Rows]:
        """Return the predictions ``(time, horizon, target)`` of each recording, moved.

        Args:
            recordings: recordings with the twin's channels.
            predictions: the network's own.
            carry: keep what was learned from one recording to the next.
            learn: False freezes the numbers.

        Raises:
            DataError: a channel of the twin is missing.
        """
        self.correction.tuned.learn = learn
        task, moved = self._twin.channels.task(), []
        for recording, predicted in zip(recordings, predictions, strict=True):
            try:
                part = task.series(matched(self._twin.channels, recording))
            except DataError as error:
                raise DataError(f"recording '{recording.name}': {error}") from error
            if carry:
                self.correction.interrupt()
            else:
                self.correction.reset()
            rows = zip(part.inputs, part.targets, predicted, oil_celsius(recording).tolist(), strict=True)
            moved.append(np.stack([self.correction.step(*row) for row in rows]))
        return moved
