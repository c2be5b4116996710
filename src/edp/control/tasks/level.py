"""A level bucket: boom and arm move, the bucket keeps its attitude, as with a load that must not spill."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.control.geometry import TipGeometry
from edp.control.reference import TipReference, reference_of_tip
from edp.control.tasks.base import TASKS, TaskSpec
from edp.control.tasks.grade import START
from edp.control.tasks.time_law import duration_s, timed


@TASKS.register("level")
@dataclass(frozen=True, kw_only=True)
class LevelBucket(TaskSpec):
    """Straight stroke motion of boom and arm between random strokes at constant bucket attitude."""

    def drawn(self, rng: np.random.Generator, geometry: TipGeometry, rate_hz: float, name: str) -> TipReference:
        """Return two random poses with the bucket attitude of the first."""
        start, goal = rng.uniform(*START, (2, 3)) * geometry.full_m
        goal[2] = start[2]
        speed = self.draw_speed(rng)
        # The pin's way is not known before its path is; that of the tip at a fixed bucket stroke is about as long.
        way = float(np.hypot(*np.diff(geometry.tip(np.array([start, goal]))[:, :2], axis=0).T).item())
        seconds = [duration_s(way, speed, self.ramp_s)]
        points = np.array([start, goal])
        rows, judged = timed(points, seconds, rate_hz, self.ramp_s, self.law, self.lead_s, self.hold_s)
        poses = geometry.tip(rows)
        bucket, attitude = geometry.machine.bodies.length[2], poses[0, 2]
        # Tip of each row, then back to the bucket's pin, then on at the attitude that is to stay.
        poses[:, 0] += bucket * (np.cos(attitude) - np.cos(poses[:, 2]))
        poses[:, 1] += bucket * (np.sin(attitude) - np.sin(poses[:, 2]))
        poses[:, 2] = attitude
        return reference_of_tip(name, poses, geometry, rate_hz, judged, self.margin)
