"""Bucket pose: tip pose from joint angles, and strokes for a tip pose.

The frame has its origin in the boom foot, x forward, y up. The attitude is the absolute angle of the line from the
bucket pin to the tip.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.physics import linkage
from edp.sim.physics.jit import compiled

Array = NDArray[np.float64]

# look[...]: what `look_at` writes
STROKE, ANGLE, JOINT_RATE, SPEED, TIP = 0, 3, 6, 9, 12
LOOK_VALUES = 15
# reached[...]: what `reach` writes: stroke shares, joint angles, and 1 where the pose can be reached
REACHED_STROKE, REACHED_ANGLE, REACHABLE = 0, 3, 6
REACHED_VALUES = 7


@compiled
def look_at(state: Array, axes: Array, plant: Array, look: Array) -> None:
    """Compute stroke fractions, joint angles (rad), rates (rad/s), cylinder speeds (m/s), tip pose (m, m, rad)."""
    x = y = angle = 0.0
    for i in range(at.AXES):
        psi = state[at.PSI + i]
        length, lever = linkage.cylinder(i, psi, plant)
        look[STROKE + i] = (length - axes[i, at.CLOSED]) / axes[i, at.STROKE]
        look[ANGLE + i] = psi
        look[JOINT_RATE + i] = state[at.RATE + i]
        look[SPEED + i] = lever * state[at.RATE + i]
        angle += psi
        x += axes[i, at.LENGTH] * math.cos(angle)
        y += axes[i, at.LENGTH] * math.sin(angle)
    look[TIP], look[TIP + 1], look[TIP + 2] = x, y, angle


@compiled
def reach(x: float, y: float, attitude: float, axes: Array, plant: Array, limits: Array, reached: Array) -> None:
    """Compute strokes (fractions of full stroke) and joint angles of a tip pose with the elbow up, into `reached`.

    `limits` is `joint_limits`. Where the pose lies outside the linkage, the nearest angles on the way there are given
    and REACHABLE is 0.
    """
    boom, arm, bucket = axes[0, at.LENGTH], axes[1, at.LENGTH], axes[2, at.LENGTH]
    pin_x, pin_y = x - bucket * math.cos(attitude), y - bucket * math.sin(attitude)
    cosine = (pin_x * pin_x + pin_y * pin_y - boom * boom - arm * arm) / (2.0 * boom * arm)
    fits = abs(cosine) <= 1.0
    elbow = -math.acos(min(max(cosine, -1.0), 1.0))
    first = math.atan2(pin_y, pin_x) - math.atan2(arm * math.sin(elbow), boom + arm * math.cos(elbow))
    middle = 0.5 * (limits[2, 0] + limits[2, 1])
    # Of all equal attitudes the turn that is nearest to the middle of the bucket's range.
    last = middle + (attitude - first - elbow - middle + math.pi) % (2.0 * math.pi) - math.pi
    reached[REACHED_ANGLE], reached[REACHED_ANGLE + 1], reached[REACHED_ANGLE + 2] = first, elbow, last
    for i in range(at.AXES):
        psi = reached[REACHED_ANGLE + i]
        # 1e-9 rad: rounding at exactly full stroke is no pose out of reach.
        if psi < limits[i, 0] - 1e-9 or psi > limits[i, 1] + 1e-9:
            fits = False
        psi = min(max(psi, limits[i, 0]), limits[i, 1])
        length = linkage.cylinder(i, psi, plant)[0]
        share = (length - axes[i, at.CLOSED]) / axes[i, at.STROKE]
        reached[REACHED_STROKE + i] = min(max(share, 0.0), 1.0)
    reached[REACHABLE] = 1.0 if fits else 0.0


@compiled
def angle_at(axis: int, stroke: float, axes: Array, plant: Array, limits: Array) -> float:
    """Return the joint angle (rad) at a stroke (m from closed), by bisection between `joint_limits`."""
    target = stroke + axes[axis, at.CLOSED]
    low, high = limits[axis, 0], limits[axis, 1]
    # The boom's length alone grows with its angle.
    rising = linkage.cylinder(axis, low, plant)[0] < linkage.cylinder(axis, high, plant)[0]
    # 52 halvings of at most pi end at the spacing of float64.
    for _ in range(52):
        middle = 0.5 * (low + high)
        if (linkage.cylinder(axis, middle, plant)[0] < target) == rising:
            low = middle
        else:
            high = middle
    angle: float = 0.5 * (low + high)
    return angle


@compiled
def fill_poses(strokes: Array, axes: Array, plant: Array, limits: Array, out: Array) -> None:
    """Write tip poses at strokes in m from closed, both of shape (time, 3), to `out`."""
    for k in range(strokes.shape[0]):
        x = y = angle = 0.0
        for i in range(at.AXES):
            angle += angle_at(i, strokes[k, i], axes, plant, limits)
            x += axes[i, at.LENGTH] * math.cos(angle)
            y += axes[i, at.LENGTH] * math.sin(angle)
        out[k, 0], out[k, 1], out[k, 2] = x, y, angle


@compiled
def fill_strokes(poses: Array, axes: Array, plant: Array, limits: Array, reached: Array, out: Array) -> None:
    """Write strokes in m from closed at tip poses, both of shape (time, 3), to `out`; NaN out of reach."""
    for k in range(poses.shape[0]):
        reach(poses[k, 0], poses[k, 1], poses[k, 2], axes, plant, limits, reached)
        for i in range(at.AXES):
            stroke = reached[REACHED_STROKE + i] * axes[i, at.STROKE]
            out[k, i] = stroke if reached[REACHABLE] > 0.5 else math.nan


def joint_limits(axes: Array, plant: Array) -> Array:
    """Return the joint angles (rad) at the ends of each stroke, lower first, shape (3, 2)."""
    ends = [[linkage.angle_at_stroke(i, share * axes[i, at.STROKE], axes, plant) for share in (0, 1)] for i in range(3)]
    return np.sort(np.array(ends), axis=1)


def tip_pose(angles: Array, axes: Array) -> tuple[float, float, float]:
    """Return the tip x and y (m) and attitude (rad) at joint angles, shape (3,)."""
    absolute = np.cumsum(angles)
    lengths = axes[:, at.LENGTH]
    return float(lengths @ np.cos(absolute)), float(lengths @ np.sin(absolute)), float(absolute[2])


class Kinematics:
    """From strokes to tip poses and back, for one machine.

    Args:
        axes: axes of `parameters.pack`.
        plant: plant parameters of `parameters.pack`.
    """

    def __init__(self, axes: Array, plant: Array) -> None:
        self.axes, self.plant, self.limits = axes, plant, joint_limits(axes, plant)

    def angles_at(self, strokes: Array) -> Array:
        """Return the joint angles (rad, shape (3,)) at strokes (fractions of full stroke)."""
        angles = [
            linkage.angle_at_stroke(i, float(strokes[i]) * self.axes[i, at.STROKE], self.axes, self.plant)
            for i in range(2)
        ]
        low, high = float(self.limits[2, 0]), float(self.limits[2, 1])
        target = float(strokes[2]) * self.axes[2, at.STROKE] + self.axes[2, at.CLOSED]
        # 50 halvings of at most pi reach 3e-15 rad.
        for _ in range(50):
            middle = 0.5 * (low + high)
            if linkage.cylinder(2, middle, self.plant)[0] > target:
                low = middle
            else:
                high = middle
        return np.array([*angles, 0.5 * (low + high)])

    def pose_at(self, strokes: Array) -> tuple[float, float, float]:
        """Return tip x, y (m) and attitude (rad) at strokes (fractions of full stroke)."""
        return tip_pose(self.angles_at(strokes), self.axes)

    def strokes_at(self, x: float, y: float, attitude: float) -> Array | None:
        """Return the strokes (fractions of full stroke, shape (3,)) for a tip pose; None if it is unreachable."""
        reached = np.empty(REACHED_VALUES)
        reach(x, y, attitude, self.axes, self.plant, self.limits, reached)
        return reached[:3] if reached[REACHABLE] > 0.5 else None

    def poses(self, strokes: Array) -> Array:
        """Return the tip x, y (m) and attitude (rad) at strokes in m from closed, both of shape (..., 3)."""
        strokes = np.asarray(strokes, dtype=float)
        out = np.empty((strokes.size // 3, 3))
        fill_poses(np.ascontiguousarray(strokes.reshape(-1, 3)), self.axes, self.plant, self.limits, out)
        return out.reshape(strokes.shape)

    def strokes(self, poses: Array) -> Array:
        """Return the strokes in m from closed that put the tip at poses (x, y in m, attitude in rad).

        Both of shape (..., 3).

        NaN where a pose cannot be reached.
        """
        poses = np.asarray(poses, dtype=float)
        out = np.empty((poses.size // 3, 3))
        fill_strokes(
            np.ascontiguousarray(poses.reshape(-1, 3)),
            self.axes,
            self.plant,
            self.limits,
            np.empty(REACHED_VALUES),
            out,
        )
        return out.reshape(poses.shape)
