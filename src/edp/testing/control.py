"""A twin of the simulator that is fitted at once, for tests of closed loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edp.control.plant import STROKES
from edp.data.twin_channels import twin_channels
from edp.networks.twin import TWINS, Twin, fit_scales
from edp.sim.machine.machine_files import load_machine
from edp.sim.scenario import Scenario
from edp.sim.simulate import simulate

WAYS = ("combined", "isolated", "end_stops")
SECONDS = 40.0


def sample_excavator_twin(machine: str = "M22", kind: str = "static") -> Twin:
    """A twin of one of the floors, fitted to two minutes of a simulated machine in free air.

    Args:
        machine: name or file of the machine.
        kind: of `edp.networks.twin.TWINS`, one that needs no training.
    """
    recordings = [
        simulate(Scenario(machine=machine, excitation=way, duration_s=SECONDS, seed=seed))
        for seed, way in enumerate(WAYS)
    ]
    channels = twin_channels(recordings[0])
    series = [channels.task().series(recording) for recording in recordings]
    scales = fit_scales(channels, series)
    # So little data does not reach all ends of the strokes, which are the stops of a twin.
    low, high = scales.low.copy(), scales.high.copy()
    names = [channel.name for channel in channels.answers]
    for name, full in zip(STROKES, load_machine(machine).cylinders.stroke, strict=True):
        low[names.index(name)], high[names.index(name)] = 0.0, np.float32(full)
    twin: Twin = TWINS[kind]().start(channels, replace(scales, low=low, high=high), series, 0)
    return twin
