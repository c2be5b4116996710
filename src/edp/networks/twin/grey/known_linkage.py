"""Linkage of a machine file for a grey box: joint angles over strokes, lengths, and initial bodies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.elements import Elements
from edp.networks.twin.parameters import Parameter
from edp.networks.twin.scales import TwinScales
from edp.wording import typed

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
BODY_NAMES = ("boom", "arm", "bucket")
"""Names of the bodies that the cylinders turn, from the first joint on, as in machine files."""
GIGA = 1e6
"""Factor from Gg to kg."""
BEYOND = 0.03
"""Fraction of the machine's stroke by which recorded strokes may exceed its ends, to allow for sensor offsets and
compliant stops."""
ANGLE_STEP = 1e-5
"""Angle step for the numerical derivative of a lever arm, rad. The relative error is about 1e-10."""
MASS_WIDTH, CENTRE_WIDTH, INERTIA_WIDTH = 0.5, (0.15, 0.1), 0.6
"""Prior standard deviations of a body relative to the machine file: logarithm of the mass, centre of mass along and
across the body (fractions of its length), and logarithm of the inertia. They allow for other buckets and for the mass
of lines and oil."""


@dataclass(frozen=True, eq=False)
class KnownLinkage:
    """Three bodies in a row, each turned by one cylinder.

    Attributes:
        values: linkage parameters in the order of `parameter_index` ``(LINKAGE_VALUES,)``, rounded to the precision of
            a bundle.
        bodies: mass (Gg), centre of gravity (m) and inertia about it (Gg m^2) of each body, in that order; a fit
            starts from them ``(BODIES * BODY_VALUES,)``.
    """

    values: Array
    bodies: Array

    SHAPES: ClassVar[dict[str, tuple[int, ...]]] = {
        "linkage": (at.LINKAGE_VALUES,),
        "bodies": (at.BODIES * at.BODY_VALUES,),
    }

    @staticmethod
    def read(name: str, elements: Elements, channels: TwinChannels, scales: TwinScales) -> KnownLinkage:
        """Read the linkage of a machine.

        Args:
            name: name of the machine, or path of its file.
            elements: elements whose cylinders have the names in `BODY_NAMES`.
            channels: channels of the twin.
            scales: whose bounds are the ends of the strokes in the recordings.

        Raises:
            ConfigError: no such machine, or strokes that it does not have.
        """
        # Here: a simulator compiles its own code.
        from edp.sim.machine import layout as sim
        from edp.sim.machine.machine_files import load_machine
        from edp.sim.machine.parameters import pack

        machine = load_machine(name)
        axes, plant = pack(machine)
        values = np.zeros(at.LINKAGE_VALUES)
        values[at.GRAVITY] = machine.gravity
        values[at.LENGTH : at.JOINTS] = machine.bodies.length[: at.BODIES - 1]
        names = [one.name for one in elements.actuators]
        for body, own in enumerate(BODY_NAMES):
            which = names.index(own)
            _check_stroke(machine.name, elements, which, float(axes[body, sim.STROKE]), channels, scales)
            joint = at.JOINTS + body * at.JOINT_VALUES
            values[joint + at.ACTUATOR] = which
            values[joint + at.KNOT : joint + at.JOINT_VALUES] = _knots(body, axes, plant).ravel()
        own_bodies = machine.bodies
        columns = (own_bodies.mass, own_bodies.com_x, own_bodies.com_y, own_bodies.inertia)
        bodies = np.array(columns).T / np.array([GIGA, 1.0, 1.0, GIGA])
        return KnownLinkage(_single(values), _single(bodies.ravel()))

    @staticmethod
    def from_arrays(arrays: Mapping[str, Singles]) -> KnownLinkage:
        """Create the linkage from the arrays of a bundle, which may be damaged.

        Raises:
            ValueError: no linkage.
        """
        values, bodies = (arrays[name].astype(np.float64) for name in KnownLinkage.SHAPES)
        joints = values[at.JOINTS :].reshape(at.BODIES, at.JOINT_VALUES)
        strokes, _, slopes, _ = np.moveaxis(joints[:, at.KNOT :].reshape(at.BODIES, -1, at.KNOT_VALUES), 2, 0)
        whole = sorted(joints[:, at.ACTUATOR]) == list(range(at.BODIES))
        turning = (slopes > 0.0).all(axis=1) | (slopes < 0.0).all(axis=1)
        if not (whole and turning.all() and (np.diff(strokes) > 0.0).all()):
            raise ValueError("its linkage does not turn each body by one cylinder")
        if not (bodies.reshape(at.BODIES, at.BODY_VALUES)[:, [at.MASS, at.INERTIA]] > 0.0).all():
            raise ValueError("one of the bodies of its linkage has no mass or inertia")
        return KnownLinkage(values, bodies)

    def arrays(self) -> dict[str, Singles]:
        """Return the arrays for a bundle."""
        return {"linkage": self.values.astype(np.float32), "bodies": self.bodies.astype(np.float32)}

    def numbers(self) -> list[Parameter]:
        """Return masses, centres of gravity and inertias, beginning with the first body."""
        lengths = [*self.values[at.LENGTH : at.JOINTS], 0.0]
        rows = []
        for name, length, own in zip(BODY_NAMES, lengths, self.bodies.reshape(at.BODIES, -1), strict=True):
            # The last body carries no other body; its length is about twice the distance of its centre of mass.
            size = length or max(2.0 * float(np.hypot(own[at.CENTRE_X], own[at.CENTRE_Y])), 1e-3)
            element = f"{name}_body"
            along, across = (share * size for share in CENTRE_WIDTH)
            rows += [
                Parameter(element, "mass", "kg", GIGA, own[at.MASS], MASS_WIDTH),
                Parameter(element, "centre_along", "m", 1.0, own[at.CENTRE_X], along, False),
                Parameter(element, "centre_across", "m", 1.0, own[at.CENTRE_Y], across, False),
                Parameter(element, "inertia_about_centre", "kg m^2", GIGA, own[at.INERTIA], INERTIA_WIDTH),
            ]
        return rows


def check_linkage(machine: str, elements: Elements, channels: TwinChannels) -> None:
    """Raise ConfigError for elements that do not match a linkage.

    Raises:
        ConfigError: other cylinders, motors, or strokes that are not measured.
    """
    names = [one.name for one in elements.cylinders]
    others = [one.name for one in elements.motors]
    motors = f" and the motors {', '.join(others)}" if others else ""
    if others or sorted(names) != sorted(BODY_NAMES):
        raise ConfigError(
            f"grey box: twin.linkage = '{machine}' is that of three cylinders called {', '.join(BODY_NAMES)}; this "
            f"twin has the cylinders {', '.join(names) or 'none'}{motors}: name them so in [[twin.cylinders]], or "
            "leave twin.linkage out"
        )
    if not channels.strokes:
        raise ConfigError(
            f"grey box: twin.linkage = '{machine}' needs the strokes of all three cylinders, and this twin has none; "
            "name them in channels.strokes, or leave twin.linkage out"
        )


def _check_stroke(
    machine: str, elements: Elements, which: int, stroke: float, channels: TwinChannels, scales: TwinScales
) -> None:
    """Refuse recordings whose strokes the machine does not have."""
    column = [c.name for c in channels.velocities].index(elements.actuators[which].velocity)
    answer = len(channels.velocities) + column
    low, high = float(scales.low[answer]), float(scales.high[answer])
    if low < -BEYOND * stroke or high > (1.0 + BEYOND) * stroke:
        raise ConfigError(
            f"grey box: '{channels.strokes[column].name}' lies from {typed(low)} to {typed(high)} m in the "
            "recordings; the "
            f"linkage of machine {machine} has strokes from 0 to {typed(stroke)} m (retracted to extended): correct "
            "offset and scale in the signal map, or name another machine in twin.linkage"
        )


def _knots(body: int, axes: Array, plant: Array) -> Array:
    """Return the stroke (m), joint angle (rad) and its first two derivatives by the stroke ``(knot, 4)``."""
    from edp.sim.machine import layout as sim
    from edp.sim.physics import linkage

    # Dense near the ends, where lever arms fall steeply: with even distances the bucket's are 0.3 % off there.
    shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, at.LINKAGE_KNOTS))
    strokes = axes[body, sim.STROKE] * shares
    angles = [linkage.angle_at_stroke(body, float(stroke), axes, plant) for stroke in strokes]
    rows = []
    for stroke, angle in zip(strokes, angles, strict=True):
        lever = linkage.cylinder(body, angle, plant)[1]
        near = [linkage.cylinder(body, angle + side * ANGLE_STEP, plant)[1] for side in (-1, 1)]
        bend = (near[1] - near[0]) / (2.0 * ANGLE_STEP)
        # d psi / d x = 1 / J, and that once more by x.
        rows.append((stroke, angle, 1.0 / lever, -bend / lever**3))
    return np.array(rows)


def _single(values: Array) -> Array:
    return values.astype(np.float32).astype(np.float64)
