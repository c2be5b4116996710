"""Common base of tasks: registry, random parameters from a seed, and the feasibility check."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import TipGeometry
from edp.control.limits import LoopLimits
from edp.control.reference import TipReference, check_speeds, reference_of_tip
from edp.control.tasks.time_law import LAWS, duration_s, timed
from edp.errors import ConfigError
from edp.registry import Registry
from edp.settings.bounds import SEED, above, below, check_bounds, integer, span
from edp.sim.excitation.levers import speed_table
from edp.wording import setting_text, typed

Array = NDArray[np.float64]
TRIES = 200
"""Maximum number of random draws of a task. If 1 % of the draws are valid, 87 % of the seeds succeed."""
SPEED_RESERVE = 0.8
"""Maximum reference speed as a fraction of a cylinder's free-air top speed, because moving cylinders share the flow."""
SPEED_M_S = (0.3, 0.5)
"""Range of the tip speed for tasks that draw it, m/s: typical for grading."""


@dataclass(frozen=True, eq=False)
class ControlTask:
    """A reference to follow, with what belongs to it.

    Attributes:
        name: name in `TASKS`.
        reference: reference to follow.
        limits: limits to respect.
        material: soil in which the bucket works; empty for free air.
        seed: seed of the draw.
    """

    name: str
    reference: TipReference
    limits: LoopLimits
    material: str
    seed: int


@dataclass(frozen=True, kw_only=True)
class TaskSpec(ABC):
    """Options of a task; subclasses draw the path.

    Attributes:
        speed_m_s: top speed of the tip; None draws it from `SPEED_M_S`.
        law: time law, see `edp.control.tasks.time_law.LAWS`.
        ramp_s: time to speed up and to slow down, s.
        lead_s: rest before the start, not evaluated.
        hold_s: rest after the end, evaluated.
        margin: fraction of the stroke at either end that a reference leaves free.
        material: soil; empty for free air.
        limits: limits of the loop.
    """

    speed_m_s: float | None = None
    law: str = "s_curve"
    ramp_s: float = 0.5
    lead_s: float = 0.5
    hold_s: float = 1.0
    margin: float = 0.04
    material: str = ""
    limits: LoopLimits = field(default_factory=LoopLimits)

    def __post_init__(self) -> None:
        check_bounds(
            "task",
            self,
            speed_m_s=above(0.0, 10.0),
            ramp_s=above(0.0, 10.0),
            lead_s=span(0.0, 60.0),
            hold_s=span(0.0, 60.0),
            margin=below(0.0, 0.5),
        )
        LAWS[self.law]
        if self.margin < self.limits.stroke_margin:
            raise ConfigError(
                f"task: margin = {setting_text(self.margin)} lets references go where limits.stroke_margin = "
                f"{typed(self.limits.stroke_margin)} does not; margin >= stroke_margin must hold"
            )

    @abstractmethod
    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return a reference with random parameters.

        Raises:
            ConfigError: it cannot be reached; other numbers are drawn then.
        """

    def draw_speed(self, rng: np.random.Generator) -> float:
        """Return the speed of the tip, m/s."""
        return float(rng.uniform(*SPEED_M_S)) if self.speed_m_s is None else self.speed_m_s

    def tip_reference(
        self, name: str, points: Array, speed: float, geometry: TipGeometry, rate_hz: float
    ) -> TipReference:
        """Return a reference along straight segments of tip poses, shape (legs + 1, 3), with the given top speed (m/s).

        Raises:
            ConfigError: it cannot be reached.
        """
        # A turn of the bucket counts as the way of a point half of its length from the pin.
        turned = 0.5 * geometry.machine.bodies.length[2]
        ways = np.hypot(np.hypot(*np.diff(points[:, :2], axis=0).T), turned * np.diff(points[:, 2]))
        seconds = [duration_s(float(way), speed, self.ramp_s) for way in ways]
        poses, judged = timed(points, seconds, rate_hz, self.ramp_s, self.law, self.lead_s, self.hold_s)
        return reference_of_tip(name, poses, geometry, rate_hz, judged, self.margin)


def check_order(what: str, **ranges: tuple[float, float]) -> None:
    """Refuse ranges whose ends are the wrong way round.

    Raises:
        ConfigError: names the first one.
    """
    for name, (low, high) in ranges.items():
        if low > high:
            raise ConfigError(f"{what}: {name} = {[low, high]}; the smaller number first must hold")


TASKS: Registry[type[TaskSpec]] = Registry("task")
"""Registry of the task settings by name. Each task has a file and a registration."""


def draw_task(spec: TaskSpec, geometry: TipGeometry, rate_hz: float, seed: int) -> ControlTask:
    """Return a feasible task: parameters are sampled until strokes and speeds are within the machine's limits.

    Args:
        spec: options of a registered task.
        geometry: geometry of the machine.
        rate_hz: sampling rate in Hz.
        seed: random seed; equal seeds give equal tasks.

    Raises:
        ConfigError: no draw fits; the message is that of the last one, with the pose or stroke and its time.
    """
    if not SEED.holds(seed):
        raise ConfigError(f"task: seed = {seed}; {SEED.rule('seed')} must hold")
    if not integer(1, 100_000).holds(round(rate_hz)):
        raise ConfigError(f"task: {typed(rate_hz)} Hz; 1 to 100,000 Hz must hold")
    name = TASKS.name_of(spec)
    fastest = SPEED_RESERVE * speed_table(geometry.machine)[1][:, :, -1].T
    rng = np.random.default_rng(seed)
    reason, within = "", 0
    for _ in range(TRIES):
        try:
            reference = spec.drawn(rng, geometry, rate_hz, name)
            within += 1
            check_speeds(name, reference, geometry, fastest)
        except ConfigError as error:
            reason = str(error)
            continue
        return ControlTask(name, reference, spec.limits, spec.material, seed)
    raise ConfigError(
        f"task '{name}', seed {seed}: none of {TRIES} draws can be done ({TRIES - within} leave reach or strokes, "
        f"{within} are too fast for a cylinder): give a shorter or slower one; the last: {reason}"
    )
