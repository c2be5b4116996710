"""Fits a law of the ground to logs in soil: to the forces by which a machine lags behind its grey box of free air."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.networks.twin.disturbance_observer import LOG_SHARE, DisturbanceObserver
from edp.networks.twin.grey.ground import GROUNDS, GroundLaw, check_grounded
from edp.networks.twin.greybox import GreyTwin
from edp.training.fitted_twin import FittedTwin

Array = NDArray[np.float64]
Log = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundFit(FittedTwin):
    """A twin of free air with a fitted law of the ground.

    Attributes:
        law: ground law. The datasheet has its parameters.
    """

    law: GroundLaw


def fit_ground(
    kind: str, twin: GreyTwin, train: Sequence[Series], validation: Sequence[Series], machine: str
) -> GroundFit:
    """Fit the law to the training data. The data have its R^2 in each part, None in a part without contact.

    Args:
        kind: name in `GROUNDS`.
        twin: twin of free air; it stays as it is.
        train: recordings in soil.
        validation: recordings in soil for a further R^2.
        machine: machine of the twin's linkage.

    Raises:
        EdpError: the twin can carry no ground, or the recordings are hardly ever in one.
    """
    started = time.process_time()
    check_grounded(twin)
    parts = {"train": [read_forces(twin, one) for one in train]}
    parts["validation"] = [read_forces(twin, one) for one in validation]
    law = GROUNDS[kind].from_logs(twin, parts["train"], machine)
    shares = {part: law.r_squared(twin, logs) if logs else float("nan") for part, logs in parts.items()}
    explained = {part: share if np.isfinite(share) else None for part, share in shares.items()}
    seconds = time.process_time() - started
    facts = {"kind": kind, "explained": explained, "seconds": round(seconds, 2)}
    rows = tuple(law.rows())
    return GroundFit(twin=twin, history=[], seconds=seconds, datasheet=rows, facts={"ground": facts}, law=law)


def read_forces(twin: GreyTwin, series: Series) -> Log:
    """Return the strokes (m), velocities (m/s) and forces (N) against each actuator ``(tick, actuator)`` along a log.

    Forces are `DisturbanceObserver`'s, told all channels tick by tick; ticks of the prefix have no row.
    """
    columns, prefix = twin.wiring.columns, twin.prefix_ticks
    speeds, strokes = (np.array([column[k] for column in columns]) for k in (0, 1))
    runner = twin.runner()
    estimate = DisturbanceObserver(runner, np.arange(len(columns)), LOG_SHARE)
    state = twin.reset(series.inputs[None, :prefix], series.targets[None, :prefix])
    forces = np.zeros((max(series.samples - prefix, 0), len(columns)))
    for row, tick in enumerate(range(prefix, series.samples)):
        measured = series.targets[tick]
        estimate.update(measured[: len(columns)].astype(float))
        if runner.resistance is not None:
            forces[row] = runner.resistance[speeds]
        before, state = state, runner.step(series.inputs[tick], state, measured)
        estimate.expect(series.inputs[tick], measured, before, state)
    rows = series.targets[prefix:].astype(float)
    measured_rows = np.isfinite(rows[:, [*speeds, *strokes]]).all(axis=1)
    return rows[measured_rows][:, strokes], rows[measured_rows][:, speeds], forces[measured_rows]
