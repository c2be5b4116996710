"""A twin of the simulator that is fitted at once, for tests of closed loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from edp.control.plant import STROKES
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels, twin_channels
from edp.networks.twin import TWINS, Twin, TwinScales, fit_scales
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.recurrent import Recurrent
from edp.sim.machine.machine_files import load_machine
from edp.sim.scenario import Scenario
from edp.sim.simulate import simulate
from edp.training.grey_fit import fit_grey_box
from edp.training.twin_bundle import TwinBundle

WAYS = ("combined", "isolated", "end_stops")
SECONDS = 40.0
PULL, CALM = 0.3, 0.2
"""Pull and memory of an untrained recurrent twin: fraction of the way to its map per sample, and contribution of its
memory."""


def sample_excavator_twin(machine: str = "M22", kind: str = "static") -> Twin:
    """Return a baseline twin fitted to two minutes of a simulated machine in free air.

    Args:
        machine: name or file of the machine.
        kind: kind in `edp.networks.twin.TWINS` that needs no training.
    """
    channels, scales, series = _sample(machine)
    twin: Twin = TWINS[kind]().start(channels, scales, series, 0)
    return twin


def sample_recurrent_twin(units: int, machine: str = "M22") -> TwinBundle:
    """Return a recurrent twin with a static map fitted to two minutes; its memory is random and has little effect."""
    channels, scales, series = _sample(machine)
    spec = Recurrent(units=units, valve_map=True)
    twin = spec.start(channels, scales, series, 0)
    with torch.no_grad():
        twin.network.out_weight.mul_(CALM)
        if twin.network.pull is not None:
            twin.network.pull.fill_(PULL)
    return TwinBundle(spec, twin)


def sample_grey_box(machine: str = "M22", is_fitted: bool = False) -> TwinBundle:
    """Return a grey box with the linkage of a machine, as at the start of a fit, or fitted in a few seconds."""
    channels, scales, series = _sample(machine)
    fit = GreyFitSpec(lengths_s=(0.1, 0.3), rounds=(3, 2), starts=1, ticks=1_500, final_rounds=0, validation_s=2.0)
    spec = GreyBox(linkage=machine, fit=fit) if is_fitted else GreyBox(linkage=machine)
    twin = spec.start(channels, scales, series, 0)
    return TwinBundle(spec, fit_grey_box(twin, series, series[-1:], 0).twin if is_fitted else twin)


def _sample(machine: str) -> tuple[TwinChannels, TwinScales, list[Series]]:
    """Return the channels, scales and series of two minutes of a simulated machine."""
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
    return channels, replace(scales, low=low, high=high), series
