"""Simulated sessions of a machine with and without faults, from which the diagnosis learns what faults look like."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from edp.monitor.diagnosis.causes import AtFault, FaultClass
from edp.recording import Recording
from edp.sim import Scenario, Simulation
from edp.sim.excitation import EXCITATIONS
from edp.sim.faults import FAULTS, FaultSpec, MachineFault, insert_site
from edp.sim.plan import DEFAULT_MIX

SEGMENT_S = 20.0
"""Time with one driving task within a session."""
SOILS = ("", "", "sandy_loam", "clay")
"""Half of the sessions are in free air, as in the default mix of data sets about."""
BASES = 12
"""Sessions of a draw that are sound but for their fault: one sound session serves all faults on it."""
_OPERATORS, _BASE = 11, 7
"""Streams of the seed."""


@dataclass(frozen=True)
class FaultSession:
    """One session of the dictionary.

    Attributes:
        base: index of the sound session with the same random values.
        fault: place in the classes; -1 for the sound session itself.
        size: size of the fault in the unit of its class; `neutral` for faults without a size.
        recording: recording from the start of the session.
    """

    base: int
    fault: int
    size: float
    recording: Recording


def fault_classes(kinds: Sequence[str] | None = None) -> tuple[FaultClass, ...]:
    """Return every kind of fault at every site.

    And negative sizes of kinds that have either sign as classes of their own.

    Args:
        kinds: names of the kinds; all by default.
    """
    classes = []
    for name in FAULTS if kinds is None else kinds:
        kind = FAULTS[name]
        at_fault: AtFault = "machine" if isinstance(kind, MachineFault) else "sensor"
        for site in kind.sites or ("",):
            words = insert_site(kind.words, site)
            for sign in (1.0, -1.0) if kind.signed else (1.0,):
                sizes = tuple(sign * size for size in kind.ladder)
                part = kind.component(site)
                classes.append(
                    FaultClass(name, site, part, at_fault, kind.unit, sizes, kind.neutral, kind.grave, words)
                )
    return tuple(classes)


def cases_of(classes: Sequence[FaultClass]) -> list[tuple[int, float]]:
    """Return class and size of each session of a draw: the two largest sizes; all others are interpolated.

    Negative sizes mirror positive ones (`mirrors`), and have no sessions.
    """
    return [
        (n, size)
        for n, fault in enumerate(classes)
        if not _is_negative(fault)
        for size in fault.sizes[-2:] or (fault.neutral,)
    ]


def mirrors(classes: Sequence[FaultClass]) -> dict[int, int]:
    """Return the position of the class with the opposite sign for each class."""
    numbers = {(fault.kind, fault.site): n for n, fault in enumerate(classes) if not _is_negative(fault)}
    return {numbers[fault.kind, fault.site]: n for n, fault in enumerate(classes) if _is_negative(fault)}


def _is_negative(fault: FaultClass) -> bool:
    return bool(fault.sizes) and fault.sizes[0] < fault.neutral


def simulated(
    classes: Sequence[FaultClass], machine: str, seconds: tuple[float, float], seed: tuple[int, int], rate_hz: float
) -> Iterator[FaultSession]:
    """Yield the sessions of one draw: healthy sessions, followed by one session per class and size.

    Args:
        classes: result of `fault_classes`.
        machine: name or file.
        seconds: until the onset, and after it.
        seed: seed of the dictionary, and index of the draw.
        rate_hz: sample rate of the recordings.
    """
    before, after = seconds
    cases = cases_of(classes)
    for base in range(max(1, min(BASES, len(cases)))):
        yield FaultSession(base, -1, 0.0, _session(_scenario(machine, base, before + after, seed, rate_hz), base, seed))
    for n, (number, size) in enumerate(cases):
        fault, base = classes[number], (n + seed[1] * 5) % min(BASES, len(cases))
        spec = FaultSpec(fault.kind, fault.site, size if fault.sizes else None, fault.unit, onset_s=before)
        scenario = replace(_scenario(machine, base, before + after, seed, rate_hz), faults=(spec,))
        yield FaultSession(base, number, size, _session(scenario, base, seed))


def _scenario(machine: str, base: int, seconds: float, seed: tuple[int, int], rate_hz: float) -> Scenario:
    chance = np.random.default_rng([*seed, _BASE, base])
    # As many of each soil as its share says, whichever seed: there are only a few bases.
    material = SOILS[base % len(SOILS)]
    return Scenario(
        machine=machine, duration_s=seconds, rate_hz=rate_hz, seed=int(chance.integers(2**31)), material=material
    )


def _session(scenario: Scenario, base: int, seed: tuple[int, int]) -> Recording:
    """Return a session with two ways of driving in sequence."""
    chance = np.random.default_rng([*seed, _OPERATORS, base])
    simulation = Simulation(scenario)
    shares = np.array(list(DEFAULT_MIX.values()))
    while simulation.samples < scenario.samples:
        name = str(chance.choice(list(DEFAULT_MIX), p=shares / shares.sum()))
        hand = np.random.default_rng(chance.integers(2**31))
        simulation.operator = EXCITATIONS[name](hand, scenario.rate_hz, simulation.machine)
        simulation.run(min(round(SEGMENT_S * scenario.rate_hz), scenario.samples - simulation.samples))
    return simulation.recording()


def noise_of(recording: Recording, names: Sequence[str]) -> Mapping[str, float]:
    """Return the white noise of channels, SI units: from second differences in the quietest tenth of the seconds.

    A stroke at 100 Hz hardly bends from tick to tick, so that what is left is noise and rounding.
    """
    ticks = max(8, round(recording.rate_hz))
    sizes = {}
    for name in names:
        bends = np.diff(recording.column(name).astype(np.float64), n=2)
        blocks = bends[: len(bends) // ticks * ticks].reshape(-1, ticks)
        # A second difference of white noise has six times its variance.
        sizes[name] = float(np.quantile(np.sqrt((blocks**2).mean(axis=1) / 6.0), 0.1)) if len(blocks) else 0.0
    return sizes


def add_noise(recording: Recording, sizes: Mapping[str, float], seed: Sequence[int]) -> Recording:
    """Return a recording with white noise added to channels that the simulator gives without noise."""
    values = recording.values.copy()
    for n, name in enumerate(sorted(sizes)):
        if sizes[name] > 0.0:
            chance = np.random.default_rng([*seed, n])
            values[:, recording.index(name)] += chance.normal(0.0, sizes[name], recording.samples).astype(np.float32)
    return replace(recording, values=values)
