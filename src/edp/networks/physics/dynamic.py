"""Common part of the force and the hybrid base: joint torques and the duration of an acceleration."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.data.task import Task
from edp.errors import ConfigError, closest
from edp.networks.physics.base import HEADS, RODS, PhysicsBase, PhysicsSpec
from edp.networks.physics.geometry import Pose
from edp.networks.streaming import Operation
from edp.settings.bounds import check_bounds, span

LOADS = ("none", "gravity", "all")
MAX_FADE_S = 3600.0
"""Maximum time constant of the fading, longer than any horizon. Oil stiffness takes up the force within hundredths of a
second."""
NEAR = 3e-3
"""Distance in m from the end of a stroke within which a piston stands at its stop: what sensors can tell."""


@dataclass(frozen=True, kw_only=True)
class DynamicSpec(PhysicsSpec):
    """Options of the bases that integrate forces.

    Attributes:
        load: forces subtracted from the cylinder force ``A_A p_A - A_B p_B``: ``none`` (exactly the equations of the
            thesis), ``gravity``, or ``all``: gravity, Coriolis torques, friction of the seals and forces of the end
            stops.
        decay_s: time constant in s with which the acceleration dies away over the horizon, as the oil's stiffness
            takes up the force; 0 holds it for all of the k steps, as the thesis does. 0.03 is near the best at
            100 ms on M22 and C14.

    Raises:
        ConfigError: an unknown load or a negative time.
    """

    space: ClassVar[dict[str, object]] = {"load": LOADS, "decay_s": (0.0, 0.2)}
    load: str = "all"
    # 0.03 s: measured compromise between boom and bucket at k = 10 (docs/journal, fading acceleration).
    decay_s: float = 0.03

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.load not in LOADS:
            raise ConfigError(
                f"physics: load = '{self.load}' must hold one of {', '.join(LOADS)}{closest(self.load, LOADS)}"
            )
        check_bounds("physics", self, decay_s=span(0.0, MAX_FADE_S))

    def channels(self) -> tuple[str, ...]:
        return (*super().channels(), *HEADS, *RODS)


class Dynamic(PhysicsBase):
    """A base that adds an acceleration, held or fading, to a velocity."""

    spec: DynamicSpec
    lasts: Tensor

    def __init__(self, spec: DynamicSpec, task: Task) -> None:
        super().__init__(spec, task)
        if spec.load == "all":
            self.operations |= {Operation.EXP}
        # Horizons and fading settle it; a buffer moves with the device but is not stored.
        self.register_buffer("lasts", torch.tensor(self.lasting()).unsqueeze(-1), persistent=False)

    def ahead(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> Tensor:
        start, acceleration = self.start(x, pose, rate, speed)
        return start.unsqueeze(-2) + acceleration.unsqueeze(-2) * self.lasts

    @abstractmethod
    def start(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Cylinder velocities (m/s) and accelerations (m/s^2) at the present sample, each ``(batch, time, 3)``."""

    def lasting(self) -> list[float]:
        """Return the time (s) during which an acceleration acts for each horizon: k steps, minus the fading time."""
        ahead_s = [k / self.rate_hz for k in self.task.horizons]
        fade_s = self.spec.decay_s
        # The integral of exp(-t / fade); expm1 keeps the digits where the horizon is far below the fading.
        return [fade_s * -math.expm1(-time_s / fade_s) if fade_s else time_s for time_s in ahead_s]

    def torque(self, x: Tensor, pose: Pose, rate: Tensor) -> Tensor:
        """Return the torque of the cylinders at the joints less `load` without friction, N m, ``(batch, time, 3)``."""
        own = self.geometry
        force = own.axis("HEAD_AREA") * self.take(x, HEADS) - own.axis("ROD_AREA") * self.take(x, RODS)
        torque = force * pose.lever
        if self.spec.load != "none":
            torque = torque - own.gravity_torque(pose)
        if self.spec.load == "all":
            torque = torque - own.coriolis_torque(own.couplings(pose)[1], rate)
        return torque

    def standing(self, speed: Tensor) -> Tensor:
        """Return the standstill fraction per axis (Stribeck), ``(batch, time, 3)``: 1 at standstill, 0 when moving."""
        # Stribeck's curve is smooth, so that gradients pass through zero velocity.
        return torch.exp(-(speed / self.geometry.axis("STRIBECK")).square())

    def sliding(self, pose: Pose, speed: Tensor) -> Tensor:
        """Return the torque of Coulomb and viscous friction where an axis slides, N m, ``(batch, time, 3)``."""
        own = self.geometry
        # The part that stands is left to static friction; both together would brake an axis twice.
        coulomb = (1.0 - self.standing(speed)) * torch.sign(speed) * own.axis("COULOMB")
        return (coulomb + own.axis("VISCOUS") * speed) * pose.lever

    def stopped(self, pose: Pose, torque: Tensor) -> Tensor:
        """Return 1 where an axis is pressed against the end of its stroke, which takes any force, else 0."""
        own = self.geometry
        stroke, push = pose.length - own.axis("CLOSED"), torque * pose.lever
        ends = (stroke < NEAR) & (push < 0) | (stroke > own.axis("STROKE") - NEAR) & (push > 0)
        return ends.to(torque.dtype)

    def net_torque(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> Tensor:
        """Return `torque` minus friction; a standing axis is held with up to its static friction."""
        torque = self.torque(x, pose, rate)
        if self.spec.load != "all":
            return torque
        # Forces become torques by the lever arm, whose sign depends on the linkage.
        most = self.geometry.axis("STATIC") * pose.lever.abs()
        friction = self.standing(speed) * torch.minimum(torch.maximum(torque, -most), most)
        return (torque - friction - self.sliding(pose, speed)) * (1.0 - self.stopped(pose, torque))

    def torque_arithmetic(self) -> int:
        """Return arithmetic of `net_torque`."""
        return {"none": 9, "gravity": 31, "all": 104}[self.spec.load]
