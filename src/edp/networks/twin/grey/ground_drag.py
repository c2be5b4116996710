"""Ground law `drag`: forces against the edge of the bucket by direction and depth, in ground that the edge cuts down.

At a depth d below ground that the edge has not cut yet, and a velocity w of the tip::

    F_x = -w_x / |w| A_x(d) - w_y / |w| c d,  F_y = -w_y / |w| A_y(d) + w_x / |w| c d
    A(d) = a min(d / 5 cm, 1) + b d + e d^2

A has separate non-negative parameters inwards, outwards, downwards and upwards; c acts inwards only. The first term is
the constant resistance of the edge, the others are the cut soil (the earthmoving equation is quadratic in the depth).
|w| is smoothed over `CREEP`. The ground is level before it is cut: a mean over uneven heights explained forces a little
better, but began softly, and loops hunted on it that the machine damps (docs/journal).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from edp.errors import DataError
from edp.networks.twin.disturbance_observer import LOG_SHARE
from edp.networks.twin.grey import ground_contact as contact
from edp.networks.twin.grey.ground import GROUNDS, GroundContact, GroundLaw
from edp.networks.twin.parameters import Parameter, Priors
from edp.settings.bounds import above, span

if TYPE_CHECKING:
    from edp.networks.twin.greybox import GreyTwin

Array = NDArray[np.float64]
Logs = Sequence[tuple[Array, Array, Array]]
DIRECTIONS = ("inwards", "outwards", "downwards", "upwards")
PARAMETERS = [
    Parameter("ground", f"{direction}_{part}", unit, 1.0, 0.0, width, positive=False)
    for direction in DIRECTIONS
    for part, unit, width in (("edge", "N", 2e4), ("by_depth", "N/m", 1e5), ("by_depth_squared", "N/m^2", 1e5))
]
PARAMETERS += [Parameter("ground", "across_by_depth", "N/m", 1.0, 0.0, 5e4, positive=False)]
PLAUSIBLE = Priors.from_parameters(PARAMETERS).width
"""Prior standard deviations of the ground parameters."""
MIN_DEPTH, MIN_SPEED = -0.1, 0.03
"""Minimum depth (m) and minimum speed (m/s) of the rows of a fit. In steady state the force is determined by friction
and not by the ground."""
CLEAR_M = 0.3
"""Height above the ground surface at which the bucket is in free air, m. Ground forces estimated there are model errors
and are subtracted."""
BLOCK = 200
"""Number of consecutive samples whose errors count as one, because neighbouring errors are correlated."""
ROUNDS, HUBER = 4, 1.345
MIN_ROWS = 500
METRES, BUCKET = span(-20.0, 20.0), above(0.0, 20.0)


class DragContact(GroundContact):
    """See `GroundContact`.

    Args:
        front: linkage and length of the bucket.
        numbers: parameters of the law.
        profile: heights of the ground, level.
    """

    def __init__(self, front: tuple[Array, float], numbers: Array, profile: Array) -> None:
        self._front, self._numbers, self._profile = front, numbers, profile
        self._last = np.full(1, -np.inf)

    def touches(self, strokes: Array, free: Array) -> bool:
        return bool(contact.touches(self._front, strokes, free, self._profile))

    def forces(self, strokes: Array, free: Array, slopes: Array) -> Array:
        forces = np.empty(len(strokes))
        memory = (self._profile, self._last)
        contact.hold(self._front, strokes, free, slopes, self._numbers, memory, forces)
        return forces


@GROUNDS.register("drag")
@dataclass(frozen=True, eq=False)
class DragLaw(GroundLaw):
    """The law of this file.

    Attributes:
        numbers: ``(contact.NUMBERS,)``, as `contact` orders them.
        deviations: their standard errors.
        bucket_m: distance from the bucket's pin to the edge, m.
        surface_m: height of level ground in the frame of the boom foot, m.
    """

    numbers: Array
    deviations: Array
    bucket_m: float
    surface_m: float

    @classmethod
    def from_logs(cls, twin: GreyTwin, logs: Logs, machine: str) -> DragLaw:
        """See `GroundLaw.from_logs`."""
        # Here: a simulator compiles its own code.
        from edp.sim.machine.machine_files import load_machine

        own = load_machine(machine)
        blank = np.zeros(contact.NUMBERS)
        empty = cls(blank, blank, float(own.bodies.length[-1]), -own.chassis.boom_foot_height)
        terms, forces, blocks = empty._rows_of(twin, logs)
        if len(forces) < MIN_ROWS:
            raise DataError(
                f"the tip of the bucket moves below the surface ({empty.surface_m:.2f} m from the boom foot) in "
                f"{len(forces)} ticks of the training part; {MIN_ROWS} must hold: give logs of work in the ground, "
                "or another machine in twin.linkage"
            )
        numbers, deviations = _solve_parameters(terms, forces, blocks)
        return replace(empty, numbers=numbers, deviations=deviations)

    def r_squared(self, twin: GreyTwin, logs: Logs) -> float:
        terms, forces, _ = self._rows_of(twin, logs)
        if not len(forces):
            return float("nan")
        left = forces - np.einsum("nka,k->na", terms, self.numbers)
        return float(1.0 - np.sum(left**2) / np.sum(forces**2))

    def contact(self, twin: GreyTwin) -> DragContact:
        return DragContact(self._front(twin), self.numbers, self._level(twin))

    def to_dict(self) -> dict[str, object]:
        # JSON has no infinity.
        deviations = [float(value) if np.isfinite(value) else None for value in self.deviations]
        return {
            "numbers": self.numbers.tolist(),
            "deviations": deviations,
            "bucket_m": self.bucket_m,
            "surface_m": self.surface_m,
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> DragLaw:
        numbers = np.array(plain["numbers"], float)
        deviations = np.array([np.inf if value is None else value for value in plain["deviations"]], float)
        bucket, surface = plain["bucket_m"], plain["surface_m"]
        if numbers.shape != (contact.NUMBERS,) or deviations.shape != numbers.shape:
            raise ValueError(f"its ground has not {contact.NUMBERS} numbers")
        if not np.isfinite(numbers).all() or (numbers[: contact.ACROSS] < 0.0).any() or not (deviations >= 0.0).all():
            raise ValueError("its ground has a number that is negative or not finite")
        if not BUCKET.holds(bucket) or not METRES.holds(surface):
            raise ValueError("its ground has a bucket or a surface that no machine has")
        return cls(numbers, deviations, float(bucket), float(surface))

    @property
    def parameters(self) -> list[Parameter]:
        return PARAMETERS

    def _front(self, twin: GreyTwin) -> tuple[Array, float]:
        return twin.table.linkage, self.bucket_m

    def _level(self, twin: GreyTwin) -> Array:
        reach = float(np.sum(twin.table.linkage[1:3])) + self.bucket_m
        return np.full(int(reach / contact.CELL_M) + 3, self.surface_m)

    def _rows_of(self, twin: GreyTwin, logs: Logs) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return the terms ``(row, number, actuator)``.

        Forces ``(row, actuator)`` and block of each row that a fit reads.
        """
        parts: list[tuple[Array, Array, NDArray[np.int64]]] = []
        for number, (strokes, velocities, forces) in enumerate(logs):
            tips, terms = np.empty((len(strokes), 2)), np.empty((len(strokes), contact.NUMBERS, strokes.shape[1]))
            contact.follow(self._front(twin), strokes, velocities, self._level(twin), tips, terms)
            depths, speeds = tips.T
            # Estimated forces lag behind the actual forces, so the terms get the same lag.
            terms = lfilter([LOG_SHARE], [1.0, LOG_SHARE - 1.0], terms, axis=0)
            clear = depths < -CLEAR_M
            bias = np.median(forces[clear], axis=0) if clear.sum() > BLOCK else np.zeros(strokes.shape[1])
            rows = np.flatnonzero((depths > MIN_DEPTH) & (speeds > MIN_SPEED))
            parts.append((terms[rows], forces[rows] - bias, 1_000_000 * number + rows // BLOCK))
        terms, forces, blocks = (np.concatenate(part) for part in zip(*parts, strict=True))
        return terms, forces, blocks


def _solve_parameters(terms: Array, forces: Array, blocks: NDArray[np.int64]) -> tuple[Array, Array]:
    """Solve for parameters by least squares with Huber weights; directional ones are non-negative.

    Returns standard errors, too.
    """
    scaled = terms * PLAUSIBLE[None, :, None]
    lowest = np.where(np.arange(contact.NUMBERS) < contact.ACROSS, 0.0, -np.inf)
    weight, x = np.ones(len(forces)), np.zeros(contact.NUMBERS)
    prior = np.eye(contact.NUMBERS)
    left = forces
    for _ in range(ROUNDS):
        size = np.sqrt(np.sum(left**2, axis=1))
        middle = max(float(np.median(size)), 1.0)
        weight = np.minimum(1.0, HUBER * middle / np.maximum(size, 1e-9))
        root = np.sqrt(weight) / middle
        a = (scaled * root[:, None, None]).transpose(0, 2, 1).reshape(-1, contact.NUMBERS)
        b = (forces * root[:, None]).ravel()
        # A plausible deviation weighs as much as one row.
        x = lsq_linear(np.vstack([a, prior]), np.concatenate([b, np.zeros(len(prior))]), (lowest, np.inf)).x
        left = forces - np.einsum("nka,k->na", scaled, x)
    information = np.einsum("nka,nla,n->kl", scaled, scaled, root**2) + prior
    slopes = np.einsum("nka,na,n->nk", scaled, left, root**2)
    sums = np.zeros((int(np.unique(blocks).size), contact.NUMBERS))
    np.add.at(sums, np.unique(blocks, return_inverse=True)[1], slopes)
    inverse = np.linalg.inv(information)
    spread = np.sqrt(np.diag(inverse @ (sums.T @ sums) @ inverse))
    # A parameter that acts in no sample is not identifiable from the logs.
    seen = np.abs(terms).sum(axis=(0, 2)) > 0.0
    return x * PLAUSIBLE, np.where(seen, spread * PLAUSIBLE, np.inf)
