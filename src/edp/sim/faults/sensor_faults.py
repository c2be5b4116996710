"""Sensor faults: each is a row of `FAULTS`."""

from __future__ import annotations

from collections.abc import Sequence

from edp.settings.bounds import span
from edp.signals import TABLE_A1
from edp.sim.faults.base import (
    AXES,
    CHAMBERS,
    FACTOR,
    FAULTS,
    LENGTH,
    NO_UNIT,
    PRESSURE,
    SHARE,
    TEMPERATURE,
    TIME,
    VELOCITY,
    SensorFault,
)
from edp.sim.sensors import alterations, chain

PILOTS = tuple(TABLE_A1)[12:]
PUMPS = ("pump_1", "pump_2")
PAIRS = {"boom_arm": (0, 1), "boom_bucket": (0, 2), "arm_bucket": (1, 2)}


def _each(sites: Sequence[str], *firsts: int) -> dict[str, tuple[int, ...]]:
    """Return the channels of each site: consecutive channels from each of the first indices."""
    return {site: tuple(first + index for first in firsts) for index, site in enumerate(sites)}


FAULTS.register("head_rod_swapped")(SensorFault(
    text="head and rod pressure of a cylinder are interchanged",
    part="sensors of {axis} pressures",
    words="head and rod pressure of the {axis} are interchanged",
    units=NO_UNIT,
    operation=alterations.SWAP,
    channels=_each(AXES, chain.PRESSURES, chain.PRESSURES + len(AXES)),
))  # fmt: skip

# The pilot pressure itself is unchanged.
FAULTS.register("pilot_bias")(SensorFault(
    text="a pilot pressure is shown with an offset",
    part="sensor of pilot pressure {site}",
    words="pilot pressure {site} reads {size} too {high}",
    sites=PILOTS,
    units=PRESSURE,
    ladder=(0.5, 1.0, 3.0),
    bound=span(-50.0, 50.0),
    operation=alterations.OFFSET,
    channels=_each(PILOTS, chain.PILOTS),
))  # fmt: skip

# Before range limits and converter.
FAULTS.register("pressure_bias")(SensorFault(
    text="a cylinder pressure is shown with an offset",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} reads {size} too {high}",
    sites=CHAMBERS,
    units=PRESSURE,
    ladder=(1.0, 3.0, 10.0, 30.0),
    bound=span(-500.0, 500.0),
    operation=alterations.OFFSET,
    channels=_each(CHAMBERS, chain.PRESSURES),
))  # fmt: skip

FAULTS.register("pressure_dropouts")(SensorFault(
    text="a cylinder pressure shows 0 for single ticks; the size is their share",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} drops to 0 at {size} of the ticks",
    sites=CHAMBERS,
    units=SHARE,
    ladder=(0.1, 1.0),
    bound=span(0.0, 100.0),
    operation=alterations.DROPOUT,
    channels=_each(CHAMBERS, chain.PRESSURES),
))  # fmt: skip

FAULTS.register("pressure_lag")(SensorFault(
    text="a cylinder pressure follows with a lag",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} follows with a lag of {size}",
    sites=CHAMBERS,
    units=TIME,
    ladder=(20.0, 50.0, 150.0),
    bound=span(0.0, 5000.0),
    operation=alterations.LAG,
    channels=_each(CHAMBERS, chain.PRESSURES),
))  # fmt: skip

# A transmitter without noise stays noise-free.
FAULTS.register("pressure_noise")(SensorFault(
    text="the noise of a cylinder pressure is larger by a factor",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} is noisy: by a factor of {size}",
    sites=CHAMBERS,
    units=FACTOR,
    ladder=(3.0, 10.0),
    bound=span(1.0, 1000.0),
    neutral=1.0,
    operation=alterations.NOISE,
    channels=_each(CHAMBERS, chain.PRESSURE_ERROR),
))  # fmt: skip

# Before range limits and converter.
FAULTS.register("pressure_scale")(SensorFault(
    text="a cylinder pressure is shown too large by a share",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} reads {size} too {large}",
    sites=CHAMBERS,
    units=SHARE,
    ladder=(1.0, 3.0, 10.0),
    bound=span(-100.0, 100.0),
    operation=alterations.SCALE,
    channels=_each(CHAMBERS, chain.PRESSURES),
))  # fmt: skip

FAULTS.register("pressure_stuck")(SensorFault(
    text="a cylinder pressure stays as it was",
    part="sensor of {site} pressure",
    words="{side} pressure of the {axis} stays as it was",
    sites=CHAMBERS,
    units=NO_UNIT,
    operation=alterations.STUCK,
    channels=_each(CHAMBERS, chain.PRESSURES),
))  # fmt: skip

FAULTS.register("pump_pressure_bias")(SensorFault(
    text="a pump pressure is shown with an offset",
    part="sensor of {site} pressure",
    words="pressure of {site} reads {size} too {high}",
    sites=PUMPS,
    units=PRESSURE,
    ladder=(3.0, 10.0, 30.0),
    bound=span(-500.0, 500.0),
    operation=alterations.OFFSET,
    channels=_each(PUMPS, chain.PUMPS),
))  # fmt: skip

FAULTS.register("stroke_bias")(SensorFault(
    text="a stroke is shown with an offset",
    part="sensor of {axis} stroke",
    words="stroke of the {axis} reads {size} too {high}",
    units=LENGTH,
    ladder=(2.0, 5.0, 20.0),
    bound=span(-2000.0, 2000.0),
    operation=alterations.OFFSET,
    channels=_each(AXES, chain.STROKES),
))  # fmt: skip

FAULTS.register("stroke_scale")(SensorFault(
    text="a stroke is shown too large by a share",
    part="sensor of {axis} stroke",
    words="stroke of the {axis} reads {size} too {large}",
    units=SHARE,
    ladder=(1.0, 3.0, 10.0),
    bound=span(-100.0, 100.0),
    operation=alterations.SCALE,
    channels=_each(AXES, chain.STROKES),
))  # fmt: skip

FAULTS.register("stroke_stuck")(SensorFault(
    text="a stroke stays as it was",
    part="sensor of {axis} stroke",
    words="stroke of the {axis} stays as it was",
    units=NO_UNIT,
    operation=alterations.STUCK,
    channels=_each(AXES, chain.STROKES),
))  # fmt: skip

# The temperature itself is unchanged.
FAULTS.register("temperature_offset")(SensorFault(
    text="the oil temperature is shown with an offset",
    part="sensor of oil temperature",
    words="oil temperature reads {size} too {high}",
    sites=(),
    units=TEMPERATURE,
    ladder=(5.0, 15.0),
    bound=span(-100.0, 100.0),
    operation=alterations.OFFSET,
    channels={"": (chain.OIL,)},
))  # fmt: skip

# The accelerations change places, too.
FAULTS.register("velocities_swapped")(SensorFault(
    text="velocities of two cylinders are interchanged",
    part="sensors of velocities",
    words="velocities of {pair} are interchanged",
    sites=tuple(PAIRS),
    units=NO_UNIT,
    operation=alterations.SWAP,
    channels={site: (chain.VELOCITIES + i, chain.VELOCITIES + k) for site, (i, k) in PAIRS.items()},
))  # fmt: skip

# The acceleration shows the step.
FAULTS.register("velocity_bias")(SensorFault(
    text="a velocity is shown with an offset",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} reads {size} too {high}",
    units=VELOCITY,
    ladder=(0.5, 2.0, 10.0),
    bound=span(-5000.0, 5000.0),
    operation=alterations.OFFSET,
    channels=_each(AXES, chain.VELOCITIES),
))  # fmt: skip

FAULTS.register("velocity_delay")(SensorFault(
    text="a velocity is shown late",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} is shown {size} late",
    units=TIME,
    ladder=(10.0, 20.0, 50.0),
    bound=span(0.0, 1000.0),
    operation=alterations.DELAY,
    channels=_each(AXES, chain.VELOCITIES),
))  # fmt: skip

FAULTS.register("velocity_dropouts")(SensorFault(
    text="a velocity shows 0 for single ticks; the size is their share",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} drops to 0 at {size} of the ticks",
    units=SHARE,
    ladder=(0.1, 1.0),
    bound=span(0.0, 100.0),
    operation=alterations.DROPOUT,
    channels=_each(AXES, chain.VELOCITIES),
))  # fmt: skip

# The white errors of the joint rate and of the velocity.
FAULTS.register("velocity_noise")(SensorFault(
    text="the noise of a velocity is larger by a factor",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} is noisy: by a factor of {size}",
    units=FACTOR,
    ladder=(3.0, 10.0),
    bound=span(1.0, 1000.0),
    neutral=1.0,
    operation=alterations.NOISE,
    channels=_each(AXES, chain.RATE_ERROR, chain.VELOCITY_ERROR),
))  # fmt: skip

# The acceleration follows.
FAULTS.register("velocity_scale")(SensorFault(
    text="a velocity is shown too large by a share",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} reads {size} too {large}",
    units=SHARE,
    ladder=(1.0, 3.0, 10.0),
    bound=span(-100.0, 100.0),
    operation=alterations.SCALE,
    channels=_each(AXES, chain.VELOCITIES),
))  # fmt: skip

FAULTS.register("velocity_stuck")(SensorFault(
    text="a velocity stays as it was",
    part="sensor of {axis} velocity",
    words="velocity of the {axis} stays as it was",
    units=NO_UNIT,
    operation=alterations.STUCK,
    channels=_each(AXES, chain.VELOCITIES),
))  # fmt: skip
