"""Linkage and rigid bodies of a machine as differentiable tensor operations, with the parameters stored as buffers.

The same mechanism as `edp.sim.physics.linkage` and `edp.sim.physics.dynamics`, written again for tensors: every
quantity is a rational function of cosines and sines of the relative joint angles, with a square root where two circles
meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

AXES = 3
AXIS_NUMBERS = (
    "LENGTH", "MASS", "COM_X", "COM_Y", "INERTIA", "HEAD_AREA", "ROD_AREA", "CLOSED", "STROKE",
    "COULOMB", "STATIC", "STRIBECK", "VISCOUS",
)  # fmt: skip
"""Names of the parameters per cylinder, as in `edp.sim.machine.layout`, SI units."""
PLANT_NUMBERS = (
    "GRAVITY", "BOOM_BASE", "BOOM_ROD", "BOOM_COS", "BOOM_SIN", "ARM_BASE", "ARM_ROD", "ARM_COS", "ARM_SIN",
    "PIVOT_X", "PIVOT_Y", "PIN_X", "ROCKER", "LINK", "LUG_X", "LUG_Y", "CYLINDER_X", "CYLINDER_Y",
)  # fmt: skip
SIDES = ("ROCKER_SIDE", "LINK_SIDE")
"""Names of two parameters with the values +1 or -1. Each selects one of the two intersections of circles that give the
bucket's pose from a stroke."""
SMALL = 1e-12
LEAST = 1e-6
"""Minimum squared lever arm in a denominator, m^2/rad^2. No cylinder works at a millimetre per radian."""
TURN = 1e-2
"""Half of the angle step for the numerical derivative of a lever arm, rad. The relative error is about 1e-4."""
GRID = 9
"""Number of strokes per cylinder, from end to end, for averages before data are available."""


@dataclass(frozen=True)
class Pose:
    """Cosine and sine of the relative joint angles, cylinder lengths in m, lever arms in m/rad, all ``(..., 3)``."""

    cosine: Tensor
    sine: Tensor
    length: Tensor
    lever: Tensor


def inverse(lever: Tensor) -> Tensor:
    """Return 1 / J, finite everywhere."""
    # A clamp of the square keeps the sign of the lever and a finite gradient at a dead centre.
    return lever / torch.clamp(lever.square(), min=LEAST)


def _meet(x: Tensor, y: Tensor, first2: Tensor, second2: Tensor, side: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return the intersection of two circles relative to the centre of the first; (x, y) points to the other centre.

    `first2` and `second2` are the radii squared; circles that do not meet give the nearest point on the line.
    """
    inverse = 1.0 / (x * x + y * y)
    along = 0.5 * (1.0 + (first2 - second2) * inverse)
    # Sensor noise can put circles apart by a hair; without the clamp the root would be NaN.
    across = side * torch.sqrt(torch.clamp(first2 * inverse - along * along, min=SMALL))
    return along * x - across * y, along * y + across * x


class Geometry(nn.Module):
    """Lever arms, masses and loads of one machine; empty until `read`, or until a bundle's weights are loaded."""

    axes: Tensor
    plant: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("axes", torch.zeros(AXES, len(AXIS_NUMBERS)))
        self.register_buffer("plant", torch.zeros(len(PLANT_NUMBERS) + len(SIDES)))

    def read(self, machine: str) -> None:
        """Read the parameters of a machine by name or from a TOML file.

        Raises:
            ConfigError: no such machine or file, or one that cannot be.
        """
        # The simulator brings Numba, which a bundle does without.
        from edp.sim import load_machine
        from edp.sim.machine import layout
        from edp.sim.machine.parameters import pack
        from edp.sim.physics import linkage

        axes, plant = pack(load_machine(machine))
        numbers = [plant[getattr(layout, name)] for name in PLANT_NUMBERS]
        middle = linkage.angle_at_stroke(2, 0.5 * axes[2, layout.STROKE], axes, plant)
        numbers += _sides(middle, dict(zip(PLANT_NUMBERS, numbers, strict=True)))
        with torch.no_grad():
            self.axes.copy_(torch.from_numpy(axes[:, [getattr(layout, name) for name in AXIS_NUMBERS]]))
            self.plant.copy_(torch.tensor(numbers, dtype=torch.float64))

    def axis(self, name: str) -> Tensor:
        """Return one parameter of each cylinder, ``(3,)``."""
        return self.axes[:, AXIS_NUMBERS.index(name)]

    def number(self, name: str) -> Tensor:
        """Return one parameter of the linkage, ``()``."""
        return self.plant[(*PLANT_NUMBERS, *SIDES).index(name)]

    def compute_pose_at_angles(self, angles: Tensor) -> Pose:
        """Return the pose at relative joint angles ``(..., 3)`` in rad."""
        cosine, sine = torch.cos(angles), torch.sin(angles)
        return Pose(cosine, sine, *self.cylinders(cosine, sine))

    def compute_pose_at_strokes(self, strokes: Tensor) -> Pose:
        """Return the pose at cylinder strokes ``(..., 3)`` in m from closed: cosine law and two circle pairs."""
        length = strokes + self.axis("CLOSED")
        boom = self._corner("BOOM_BASE", "BOOM_ROD", length[..., 0])
        arm = self._corner("ARM_BASE", "ARM_ROD", length[..., 1])
        bc, bs, ac, as_ = (self.number(name) for name in ("BOOM_COS", "BOOM_SIN", "ARM_COS", "ARM_SIN"))
        bucket = self._bucket_turn(length[..., 2])
        cosine = torch.stack((boom[0] * bc + boom[1] * bs, arm[0] * ac + arm[1] * as_, bucket[0]), dim=-1)
        sine = torch.stack((boom[1] * bc - boom[0] * bs, arm[0] * as_ - arm[1] * ac, bucket[1]), dim=-1)
        return Pose(cosine, sine, *self.cylinders(cosine, sine))

    def _corner(self, base: str, rod: str, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return the cosine and sine of the angle between two pin radii that a cylinder's length spans."""
        b, r = self.number(base), self.number(rod)
        cosine = (b * b + r * r - length * length) / (2.0 * b * r)
        # Rounding and noise may push a cosine beyond 1 near the end of a stroke.
        return cosine, torch.sqrt(torch.clamp(1.0 - cosine * cosine, min=SMALL))

    def _bucket_turn(self, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return cosine and sine of the bucket angle from its cylinder's length: the rocker's pin, then the lug's."""
        rocker, link = self.number("ROCKER"), self.number("LINK")
        lug_x, lug_y = self.number("LUG_X"), self.number("LUG_Y")
        away_x = self.number("CYLINDER_X") - self.number("PIVOT_X")
        away_y = self.number("CYLINDER_Y") - self.number("PIVOT_Y")
        arm_x, arm_y = _meet(away_x, away_y, rocker * rocker, length * length, self.number("ROCKER_SIDE"))
        pin_x = self.number("PIVOT_X") + arm_x - self.number("PIN_X")
        pin_y = self.number("PIVOT_Y") + arm_y
        lug2 = lug_x * lug_x + lug_y * lug_y
        x, y = _meet(pin_x, pin_y, lug2, link * link, self.number("LINK_SIDE"))
        return (lug_x * x + lug_y * y) / lug2, (lug_x * y - lug_y * x) / lug2

    def cylinders(self, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor]:
        """Return the lengths in m and lever arms J = dx/dpsi in m/rad, ``(..., 3)``, thesis eq. 3.7 (J is diagonal)."""
        bc, bs, ac, as_ = (self.number(name) for name in ("BOOM_COS", "BOOM_SIN", "ARM_COS", "ARM_SIN"))
        (c1, c2, c3), (s1, s2, s3) = cosine.unbind(-1), sine.unbind(-1)
        boom, boom_lever = self._triangle("BOOM_BASE", "BOOM_ROD", c1 * bc - s1 * bs, s1 * bc + c1 * bs)
        arm, arm_lever = self._triangle("ARM_BASE", "ARM_ROD", c2 * ac + s2 * as_, c2 * as_ - s2 * ac)
        bucket, bucket_lever = self._four_bar(c3, s3)
        # The arm's angle falls as its pin triangle opens.
        levers = torch.stack((boom_lever, -arm_lever, bucket_lever), dim=-1)
        return torch.stack((boom, arm, bucket), dim=-1), levers

    def _triangle(self, base: str, rod: str, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor]:
        """Return the length opposite to the angle between two pin radii, and its change by that angle."""
        b, r = self.number(base), self.number(rod)
        # The clamp only matters where the pin radii fold onto each other, outside any stroke.
        length = torch.sqrt(torch.clamp(b * b + r * r - 2.0 * b * r * cosine, min=SMALL))
        return length, b * r * sine / length

    def _four_bar(self, cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rocker, link and lug: a constant link gives the rocker's rate, the rocker's pin the cylinder's."""
        rocker, link = self.number("ROCKER"), self.number("LINK")
        lug_x, lug_y = self.number("LUG_X"), self.number("LUG_Y")
        dx, dy = lug_x * cosine - lug_y * sine, lug_x * sine + lug_y * cosine
        to_x, to_y = self.number("PIN_X") + dx - self.number("PIVOT_X"), dy - self.number("PIVOT_Y")
        arm_x, arm_y = _meet(to_x, to_y, rocker * rocker, link * link, 1.0)
        link_x, link_y = arm_x - to_x, arm_y - to_y
        rod_x = self.number("PIVOT_X") + arm_x - self.number("CYLINDER_X")
        rod_y = self.number("PIVOT_Y") + arm_y - self.number("CYLINDER_Y")
        length = torch.sqrt(rod_x * rod_x + rod_y * rod_y)
        turned = (link_y * dx - link_x * dy) * (rod_y * arm_x - rod_x * arm_y)
        return length, turned / ((link_y * arm_x - link_x * arm_y) * length)

    def lever_change(self, pose: Pose) -> Tensor:
        """Return dJ/dpsi in m/rad^2, ``(..., 3)``, by a central difference over `TURN` in both directions."""
        # A central difference: the derivative of the four-bar in closed form is long and would be needed in every
        # export.
        c, s = float(np.cos(TURN)), float(np.sin(TURN))
        _, ahead = self.cylinders(pose.cosine * c - pose.sine * s, pose.sine * c + pose.cosine * s)
        _, behind = self.cylinders(pose.cosine * c + pose.sine * s, pose.sine * c - pose.cosine * s)
        return (ahead - behind) * (0.5 / TURN)

    def couplings(self, pose: Pose) -> tuple[list[Tensor], list[Tensor]]:
        """Return the mass coupling of the bodies 12, 13, 23 in absolute angles, kg m^2: parts by cosine and by sine."""
        (_, m2, m3), (l1, l2, _) = self.axis("MASS"), self.axis("LENGTH")
        (_, cx2, cx3), (_, cy2, cy3) = self.axis("COM_X"), self.axis("COM_Y")
        (_, c2, c3), (_, s2, s3) = pose.cosine.unbind(-1), pose.sine.unbind(-1)
        x2, y2, x3, y3 = m2 * cx2 + m3 * l2, m2 * cy2, m3 * cx3, m3 * cy3
        c23, s23 = c2 * c3 - s2 * s3, s2 * c3 + c2 * s3
        first = l1 * (x2 * c2 - y2 * s2), l1 * (x3 * c23 - y3 * s23), l2 * (x3 * c3 - y3 * s3)
        second = l1 * (x2 * s2 + y2 * c2), l1 * (x3 * s23 + y3 * c23), l2 * (x3 * s3 + y3 * c3)
        return list(first), list(second)

    def masses(self, by_cosine: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the mass matrix in relative angles, kg m^2.

        Diagonal 11, 22, 33 and coupling 12, 13, 23, each ``(..., 3)``.
        """
        k12, k13, k23 = by_cosine
        m, length = self.axis("MASS"), self.axis("LENGTH")
        # Steiner's theorem: inertia about the joint from inertia about the centre of mass.
        about = self.axis("INERTIA") + m * (self.axis("COM_X").square() + self.axis("COM_Y").square())
        h1 = about[0] + (m[1] + m[2]) * length[0].square()
        h2 = about[1] + m[2] * length[1].square()
        h3 = about[2] + torch.zeros_like(k23)
        m22, m23 = h2 + h3 + 2.0 * k23, h3 + k23
        m13 = m23 + k13
        m12 = m22 + k12 + k13
        m11 = h1 + m22 + 2.0 * (k12 + k13)
        return torch.stack((m11, m22, h3), dim=-1), torch.stack((m12, m13, m23), dim=-1)

    def gravity_torque(self, pose: Pose) -> Tensor:
        """Return the torque that balances gravity at each joint, N m, ``(..., 3)``."""
        (c1, c2, c3), (s1, s2, s3) = pose.cosine.unbind(-1), pose.sine.unbind(-1)
        c12, s12 = c1 * c2 - s1 * s2, s1 * c2 + c1 * s2
        c13, s13 = c12 * c3 - s12 * s3, s12 * c3 + c12 * s3
        (m1, m2, m3), (l1, l2, _) = self.axis("MASS"), self.axis("LENGTH")
        (x1, x2, x3), (y1, y2, y3) = self.axis("COM_X"), self.axis("COM_Y")
        g3 = m3 * (x3 * c13 - y3 * s13)
        g2 = g3 + m2 * (x2 * c12 - y2 * s12) + m3 * l2 * c12
        g1 = g2 + m1 * (x1 * c1 - y1 * s1) + (m2 + m3) * l1 * c1
        return self.number("GRAVITY") * torch.stack((g1, g2, g3), dim=-1)

    def coriolis_torque(self, by_sine: list[Tensor], rate: Tensor) -> Tensor:
        """Return Coriolis and centrifugal torques, N m, ``(..., 3)``; `rate` holds relative joint rates in rad/s."""
        k12, k13, k23 = by_sine
        w1, w2, w3 = rate.unbind(-1)
        first, second, third = w1.square(), (w1 + w2).square(), (w1 + w2 + w3).square()
        c3 = k13 * first + k23 * second
        c2 = c3 + k12 * first - k23 * third
        c1 = c2 - k12 * second - k13 * third
        return torch.stack((c1, c2, c3), dim=-1)

    def mean_mass(self) -> Tensor:
        """Return the equivalent masses M_ii / J_i^2 in kg averaged over a uniform grid of strokes, ``(3,)``."""
        # A grid over all poses stands for training data that do not exist yet.
        share = torch.linspace(0.0, 1.0, GRID, dtype=self.axes.dtype, device=self.axes.device)
        pose = self.compute_pose_at_strokes(torch.cartesian_prod(share, share, share) * self.axis("STROKE"))
        return self.equivalent_mass(pose).mean(dim=0)

    def equivalent_mass(self, pose: Pose) -> Tensor:
        """Return M_ii / J_i^2 in kg, ``(..., 3)``: the mass moved by a cylinder if the other joints are torque-free."""
        own, _ = self.masses(self.couplings(pose)[0])
        return own / pose.lever.square()


def _sides(angle: float, number: dict[str, float]) -> list[float]:
    """Return `SIDES` of the bucket linkage branch at `angle`; the branch does not change along the stroke."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    lug = np.array([number["LUG_X"] * c - number["LUG_Y"] * s, number["LUG_X"] * s + number["LUG_Y"] * c])
    pivot, pin = np.array([number["PIVOT_X"], number["PIVOT_Y"]]), np.array([number["PIN_X"], 0.0])
    line = torch.tensor(pin + lug - pivot)
    # The branch is settled at the middle of the stroke: a linkage crosses no toggle along its stroke.
    rocker2, link2 = (torch.tensor(number[name] ** 2) for name in ("ROCKER", "LINK"))
    rocker = np.array([float(part) for part in _meet(line[0], line[1], rocker2, link2, 1.0)])

    def side(line: np.ndarray, point: np.ndarray) -> float:
        return 1.0 if line[0] * point[1] - line[1] * point[0] > 0 else -1.0

    cylinder = np.array([number["CYLINDER_X"], number["CYLINDER_Y"]])
    return [side(cylinder - pivot, rocker), side(pivot + rocker - pin, lug)]
