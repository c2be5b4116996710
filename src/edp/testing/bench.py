"""The smallest machine of a grey box: one cylinder with a valve and a pump, on a bench, at 100 Hz."""

from __future__ import annotations

from typing import Any

import numpy as np

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.networks.twin.grey.elements import CylinderElement, PumpElement, ValveElement
from edp.networks.twin.greybox import GreyBox
from edp.signals import Channel, Kind

LOWEST, HIGHEST = (-0.5, 0.0, 0.0, 0.0, 1e6), (0.5, 1.0, 2e7, 2e7, 2e7)
"""Ranges of speed, stroke, chamber and pump pressures, SI units, from which scales are taken."""


def bench_channels(lever: str = "lever", description: str = "") -> TwinChannels:
    """Return the channels of a cylinder with stroke, both chambers and its pump, moved by one lever."""
    return TwinChannels(
        (Channel(lever, Kind.RATIO, description),),
        (Channel("speed", Kind.VELOCITY),),
        (Channel("place", Kind.POSITION),),
        (Channel("head", Kind.PRESSURE), Channel("rod", Kind.PRESSURE), Channel("line", Kind.PRESSURE)),
        100.0,
    )


def bench_grey_box(**options: Any) -> GreyBox:
    """Return its grey box with additional `options`."""
    return GreyBox(
        cylinders=(CylinderElement(name="ram", velocity="speed", head="head", rod="rod", bore=0.1, rod_diameter=0.06),),
        valves=(ValveElement(name="valve", actuator="ram", extend="lever", supply="pump"),),
        pumps=(PumpElement(name="pump", pressure="line"),),
        inertia_degree=1,
        potential_degree=2,
        curve_segments=5,
        **options,
    )


def bench_series(ticks: int = 800, seed: int = 0) -> Series:
    """Return levers held for 0.4 s each ``(ticks, 1)``, and values between `LOWEST` and `HIGHEST` ``(ticks, 5)``."""
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.uniform(-1, 1, ticks // 40 + 1), 40)[:ticks]
    targets = rng.uniform(np.array(LOWEST), np.array(HIGHEST), (ticks, 5))
    return Series("levers", lever[:, None].astype(np.float32), targets.astype(np.float32))
