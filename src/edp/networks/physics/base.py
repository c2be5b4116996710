"""Physics bases: deterministic predictions of cylinder velocities that the network corrects (eq. 3.6)."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from edp.data.task import Task
from edp.errors import ConfigError, closest
from edp.ir import Builder
from edp.ir.memory import Difference
from edp.networks.blocks.base import ModelView, TaskView
from edp.networks.physics.geometry import AXES, Geometry, Pose, inverse
from edp.networks.physics.symbols import Symbol
from edp.networks.streaming import Cost, Operation, State, Streaming
from edp.registry import Registry

PHYSICS: Registry[type] = Registry("physics base")
SPEEDS = tuple(f"CylVels_{i + 1}" for i in range(AXES))
"""Names of the targets that a physics base predicts: the cylinder velocities."""
HEADS = tuple(f"CylPressures_{i + 1}" for i in range(AXES))
RODS = tuple(f"CylPressures_{i + 5}" for i in range(AXES))
ANGLE, RATE, SPEED = 0.5, 0.5, 0.2
"""Half-widths of the usual ranges of joint angles (rad), joint rates (rad/s) and cylinder velocities (m/s)."""
PRESSURE = (1e7, 5e6)
"""Middle and half-width of the usual pressure range, Pa."""
POSES = {
    # own.
    "angles": (*(f"JointAngle_{i + 1}" for i in range(AXES)), *(f"JointVel_{i + 1}" for i in range(AXES))),
    "strokes": tuple(f"CylStroke_{i + 1}" for i in range(AXES)),
}
"""Channels that contain the pose and its rate: relative joint angles and rates, or cylinder strokes from the closed
end."""


@dataclass(frozen=True, kw_only=True)
class PhysicsSpec(ABC):
    """Common settings of all physics bases.

    Attributes:
        machine: name of a machine or path of its TOML file, read when a network is made; a bundle holds its numbers.
        pose: ``angles`` (``JointAngle_*`` and ``JointVel_*``) or ``strokes`` (``CylStroke_*``, differenced for rates).

    Raises:
        ConfigError: another pose.
    """

    space: ClassVar[dict[str, object]] = {}
    machine: str = "M22"
    pose: str = "angles"

    def __post_init__(self) -> None:
        if self.pose not in POSES:
            raise ConfigError(
                f"physics: pose = '{self.pose}' must hold one of {', '.join(POSES)}{closest(self.pose, POSES)}"
            )

    def channels(self) -> tuple[str, ...]:
        """Return the logged channels that the base reads."""
        return POSES[self.pose]

    def conflicts(self, model: ModelView, task: TaskView) -> str | None:
        """Return why it cannot be added to this network, None where it can."""
        name = f"physics base '{PHYSICS.name_of(self)}'"
        missing = [channel for channel in self.channels() if channel not in task.inputs]
        if missing:
            return f"{name} reads {', '.join(missing)}, which the task does not; list them in its `physics`"
        if not any(target in SPEEDS for target in task.targets):
            return (
                f"{name} predicts {', '.join(SPEEDS)}, but the targets are {', '.join(task.targets)}; give the "
                "velocities these names in the signal map, or remove model.physics"
            )
        # The regression predicts the whole target; a physics base added to it would count the velocity twice.
        if any(getattr(block, "init", "zero") != "zero" for block in model.blocks):
            return (
                f"{name} would be added to the regression of the whole target, from which linear_bypass starts; set "
                "its init = 'zero', or remove one of them"
            )
        return None

    def digest(self) -> str:
        """Return the content address of the machine's parameters.

        Raises:
            ConfigError: no such machine or file, or one that cannot be.
        """
        geometry = Geometry()
        geometry.read(self.machine)
        state = hashlib.blake2b(digest_size=16)
        for tensor in (geometry.axes, geometry.plant):
            state.update(tensor.numpy().tobytes())
        return state.hexdigest()

    @abstractmethod
    def build(self, task: Task) -> PhysicsBase:
        """Build the base without the machine's parameters."""


class PhysicsBase(Streaming):
    """Inputs ``(batch, time, input)`` in SI units to velocities ``(batch, time, horizon, target)`` in m/s.

    `is_velocity` is 1 for the targets that are cylinder velocities and 0 for others, which the base does not predict.
    The state contains the previous strokes and a flag for them if the pose comes from strokes; otherwise there is no
    state.
    """

    is_velocity: Tensor

    def __init__(self, spec: PhysicsSpec, task: Task) -> None:
        super().__init__()
        self.spec, self.task, self.rate_hz = spec, task, task.rate_hz
        self.columns = {name: task.inputs.index(name) for name in spec.channels()}
        # Targets that are no cylinder velocity take any column; `is_velocity` takes them out.
        self.order = [SPEEDS.index(target) if target in SPEEDS else 0 for target in task.targets]
        is_velocity = torch.tensor([float(target in SPEEDS) for target in task.targets])
        # Not persistent: it follows from the task, so a bundle cannot contradict it.
        self.register_buffer("is_velocity", is_velocity, persistent=False)
        self.geometry = Geometry()
        # The square root is that of the linkage; strokes need no sine, since circles give the angles directly.
        self.operations = frozenset({Operation.SQRT, *((Operation.SINE,) if spec.pose == "angles" else ())})

    def read(self) -> None:
        """Read the machine's parameters, as for a new network.

        Raises:
            ConfigError: no such machine or file, or one that cannot be.
        """
        # Numbers come into buffers, so that a bundle carries the machine and needs no machine file.
        self.geometry.read(self.spec.machine)

    def settle(self, parts: Iterable[Tensor]) -> None:
        """Compute averages over training inputs ``(time, input)`` if the base needs any; most do not."""

    def usual(self) -> dict[str, tuple[float, float]]:
        # The middle of the strokes, since a middle of angles need not be a pose that the linkage reaches.
        """Return middle and width of the usual range of each channel that the base reads, SI units."""
        pose = self.geometry.at_strokes(0.5 * self.geometry.axis("STROKE"))
        middle = torch.atan2(pose.sine, pose.cosine).tolist()
        stroke = self.geometry.axis("STROKE").tolist()
        ranges = dict.fromkeys(SPEEDS, (0.0, SPEED)) | dict.fromkeys((*HEADS, *RODS), PRESSURE)
        for i in range(AXES):
            ranges[POSES["angles"][i]] = (middle[i], ANGLE)
            ranges[POSES["angles"][AXES + i]] = (0.0, RATE)
            ranges[POSES["strokes"][i]] = (0.5 * stroke[i], 0.25 * stroke[i])
        return {name: ranges[name] for name in self.columns}

    def take(self, x: Tensor, names: Sequence[str]) -> Tensor:
        """Return the input columns by name."""
        return x[..., [self.columns[name] for name in names]]

    def initial_state(self, batch: int, like: Tensor) -> State:
        if self.spec.pose == "angles":
            return ()
        return like.new_zeros(batch, 1, AXES), like.new_zeros(batch, 1, 1)

    def pose(self, x: Tensor) -> Pose:
        """Return the pose at each sample."""
        values = self.take(x, POSES[self.spec.pose][:AXES])
        return self.geometry.at_angles(values) if self.spec.pose == "angles" else self.geometry.at_strokes(values)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        pose = self.pose(x)
        if self.spec.pose == "angles":
            rate = self.take(x, POSES["angles"][AXES:])
            speed = pose.lever * rate
        else:
            strokes = self.take(x, POSES["strokes"])
            previous, seen = state
            # Nothing is known of the rate at the first tick; it is taken as rest.
            before = torch.cat([torch.where(seen > 0.5, previous, strokes[:, :1]), strokes[:, :-1]], dim=1)
            speed = (strokes - before) * self.rate_hz
            rate = speed * inverse(pose.lever)
            # The last stroke is state: the rate at a chunk's first tick needs it.
            state = strokes[:, -1:], torch.ones_like(seen)
        return self.ahead(x, pose, rate, speed)[..., self.order], state

    @abstractmethod
    def ahead(self, x: Tensor, pose: Pose, rate: Tensor, speed: Tensor) -> Tensor:
        """Return the velocities ``(batch, time, horizon, 3)`` of the cylinders.

        Args:
            x: inputs ``(batch, time, input)``.
            pose: pose at each sample.
            rate: joint rates in rad/s, ``(batch, time, 3)``.
            speed: cylinder velocities J rate in m/s, ``(batch, time, 3)``.
        """

    @abstractmethod
    def arithmetic(self) -> int:
        """Return the number of multiplications, divisions, roots, sines etc. per sample, in addition to the pose."""

    def lower(self, build: Builder, x: str) -> str:
        """Add the velocities, ``horizon * target`` elements, by recording the equations."""
        with build.inside("physics"):
            inputs = Symbol(build, x, (build.width(x),))
            # The equations are written for tensors; symbols stand in for them.
            pose = self.pose(inputs)  # type: ignore[arg-type]
            if self.spec.pose == "angles":
                rate = self.take(inputs, POSES["angles"][AXES:])  # type: ignore[arg-type]
                speed = pose.lever * rate
            else:
                strokes = self.take(inputs, POSES["strokes"])  # type: ignore[arg-type]
                factor = torch.full((AXES,), float(self.rate_hz))
                value = build.add(Difference, "speed", strokes.value, factor=factor, from_zero=False)  # type: ignore[attr-defined]
                speed = Symbol(build, value, (AXES,))  # type: ignore[assignment]
                rate = speed * inverse(pose.lever)
            velocities = self.ahead(inputs, pose, rate, speed)[..., self.order]  # type: ignore[arg-type]
            return build.join("ahead", velocities.value)  # type: ignore[attr-defined]

    def costs(self) -> list[Cost]:
        # Number of operations for the pose, verified against a trace by `edp.evaluation.mac_check`.
        count = (52 if self.spec.pose == "angles" else 101) + AXES + self.arithmetic()
        width = len(self.task.horizons) * len(self.task.targets)
        return [
            Cost(
                f"physics base ({PHYSICS.name_of(self.spec)})",
                0,
                per_prediction=count,
                width_in=len(self.columns),
                width_out=width,
                per_time_step=False,
            )
        ]
