"""A grey box of an excavator's front with M22's linkage, as tests of twins share it."""

import numpy as np

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.networks.twin.grey.elements import CylinderElement, PumpElement, ValveElement
from edp.networks.twin.greybox import GreyBox, GreyFitSpec
from edp.signals import Channel, Kind

PREFIX = 30
ORDER = ("arm", "boom", "bucket")
"""Not that of the bodies: a log may have its cylinders in any order."""


def front_channels():
    """Levers, speeds, strokes and both chambers of a front, and its pump."""
    return TwinChannels(
        tuple(Channel(f"{name}_lever", Kind.RATIO) for name in ORDER),
        tuple(Channel(f"{name}_speed", Kind.VELOCITY) for name in ORDER),
        tuple(Channel(f"{name}_place", Kind.POSITION) for name in ORDER),
        (*(Channel(f"{name}_{side}", Kind.PRESSURE) for name in ORDER for side in ("head", "rod")),
         Channel("line", Kind.PRESSURE)),
        100.0,
    )  # fmt: skip


def front(**changes):
    """A grey box of a front with M22's linkage."""
    cylinders = tuple(
        CylinderElement(
            name=name, velocity=f"{name}_speed", head=f"{name}_head", rod=f"{name}_rod", bore=0.13, rod_diameter=0.09
        )
        for name in ORDER
    )
    valves = tuple(
        ValveElement(name=f"{name} spool", actuator=name, extend=f"{name}_lever", supply="pump") for name in ORDER
    )
    options = {
        "cylinders": cylinders,
        "valves": valves,
        "pumps": (PumpElement(name="pump", pressure="line"),),
        "linkage": "m22",
        "prefix_ticks": PREFIX,
        "fit": GreyFitSpec(
            lengths_s=(0.1,), rounds=(1,), final_rounds=0, starts=1, batch=8, ticks=200, validation_s=1.0
        ),
    }
    return GreyBox(**(options | changes))


def series_of(seed=0, ticks=600, strokes=1.0):
    """Levers of a front, and plausible values that set the scales."""
    rng = np.random.default_rng(seed)
    levers = np.repeat(rng.uniform(-1, 1, (ticks // 40 + 1, 3)), 40, axis=0)[:ticks]
    full = strokes * np.array([1.504, 1.26, 1.104])
    low = np.concatenate([[-0.3] * 3, 0.02 * full, [0.0] * 7])
    high = np.concatenate([[0.3] * 3, 0.98 * full, [2e7] * 7])
    return Series("levers", levers.astype(np.float32), rng.uniform(low, high, (ticks, 13)).astype(np.float32))
