"""Time course of faults: fraction of full size at each sample, and effect on plant and observations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from edp.sim.faults.base import FAULTS, FaultSpec, MachineFault, MachineNumbers, SensorFault
from edp.sim.physics.plant import Plant
from edp.sim.sensors import alterations

Array = NDArray[np.float64]
STEPS = 1024
"""Maximum number of parameter changes during one ramp."""
BLOCKS = ("axes", "plant", "delays", "coarse", "fine", "soil")
"""Arrays of `MachineNumbers` that faults can change, in order."""
CHANGE = 4
"""Number of values per change: sample, index in `BLOCKS`, position in the block, new value."""


def shares_at(faults: Sequence[FaultSpec], ticks: NDArray[np.int64], rate_hz: float) -> Array:
    """Return the fraction of full size of each fault, 0 to 1, shape (time, fault).

    A fault begins at the first sample at or after its onset. The ramp of an intermittent fault continues during its
    inactive time.
    """
    shares = np.zeros((len(ticks), len(faults)))
    for n, fault in enumerate(faults):
        # 1e-6 of a tick allows for the rounding of decimal seconds.
        since = ticks - np.ceil(fault.onset_s * rate_hz - 1e-6)
        share = np.ones(len(ticks))
        if fault.ramp_s > 0.0:
            share = np.floor(np.clip(since / (fault.ramp_s * rate_hz), 0.0, 1.0) * STEPS + 1e-6) / STEPS
        if fault.on_s > 0.0:
            phase = np.mod(since, (fault.on_s + fault.off_s) * rate_hz)
            share = np.where(phase < fault.on_s * rate_hz - 1e-6, share, 0.0)
        shares[:, n] = np.where(since >= 0.0, share, 0.0)
    return shares


def sizes_of(fault: FaultSpec, shares: Array) -> Array:
    """Return the sizes in SI units at the given fractions of full size."""
    # Return exactly the neutral size at fraction 0, so that rounding changes no parameter.
    return np.where(shares > 0.0, fault.neutral + shares * (fault.full - fault.neutral), fault.neutral)


def select_machine_faults(faults: Sequence[FaultSpec]) -> tuple[FaultSpec, ...]:
    """Return the faults that change plant parameters."""
    return tuple(fault for fault in faults if isinstance(FAULTS[fault.kind], MachineFault))


def spare_s(faults: Sequence[FaultSpec]) -> float:
    """Return the additional dead time of commands with all faults, s."""
    pairs = [(fault, FAULTS[fault.kind]) for fault in faults]
    return sum(fault.full for fault, kind in pairs if isinstance(kind, MachineFault) and kind.delays_commands)


def numbers_of(plant: Plant) -> MachineNumbers:
    """Return the live parameters of a plant."""
    (_, coarse_s, _, coarse), (_, fine_s, _, fine) = plant.clocks
    halves = 0.5 * coarse_s, 0.5 * fine_s
    return MachineNumbers(
        plant.machine, plant.rate_hz, halves, plant.axes, plant.plant, plant.delays, coarse, fine, plant.soil_numbers
    )


class MachineCourse:
    """Parameters of one plant under faults; a function of the sample index only.

    Args:
        faults: faults of the scenario. Sensor faults are ignored.
        sound: plant parameters without faults. They are copied.
    """

    def __init__(self, faults: Sequence[FaultSpec], sound: MachineNumbers) -> None:
        self.faults = select_machine_faults(faults)
        self._sound = sound.copy()
        changed = self._numbers(np.ones(len(self.faults)))
        half = self._numbers(np.full(len(self.faults), 0.5))
        # Only parameters changed by a fault are written, because oil and load change other parameters over time.
        self._touched = [
            np.flatnonzero((a.ravel() != b.ravel()) | (a.ravel() != c.ravel()))
            for a, b, c in zip(self._sound.arrays, changed.arrays, half.arrays, strict=True)
        ]

    def write(self, tick: int, live: MachineNumbers) -> None:
        """Write the parameters of a sample to a plant, in place."""
        numbers = self._numbers(shares_at(self.faults, np.array([tick]), live.rate_hz)[0])
        for array, new, touched in zip(live.arrays, numbers.arrays, self._touched, strict=True):
            if len(touched):
                array.reshape(-1)[touched] = new.reshape(-1)[touched]

    def pieces(self, first: int, behind: int) -> Iterator[tuple[int, int]]:
        """Yield runs of samples, (first, stop), with constant parameters."""
        shares = shares_at(self.faults, np.arange(first, behind), self._sound.rate_hz)
        ends = np.flatnonzero((shares[1:] != shares[:-1]).any(axis=1)) + 1
        starts = [0, *ends.tolist(), behind - first]
        for start, end in pairwise(starts):
            yield first + start, first + end

    def changes(self, samples: int) -> Array:
        """Return all changes of parameters in the order of samples, shape (changes, CHANGE)."""
        rows: list[Array] = []
        before = [array.ravel()[touched] for array, touched in zip(self._sound.arrays, self._touched, strict=True)]
        shares = shares_at(self.faults, np.arange(samples), self._sound.rate_hz)
        for tick, _ in self.pieces(0, samples):
            numbers = self._numbers(shares[tick])
            for block, (array, touched) in enumerate(zip(numbers.arrays, self._touched, strict=True)):
                new = array.ravel()[touched]
                differ = np.flatnonzero(new != before[block])
                if len(differ):
                    columns = (np.full(len(differ), float(tick)), np.full(len(differ), float(block)))
                    rows.append(np.column_stack((*columns, touched[differ], new[differ])))
                before[block] = new
        return np.concatenate(rows) if rows else np.zeros((0, CHANGE))

    def _numbers(self, shares: Array) -> MachineNumbers:
        numbers = self._sound.copy()
        for fault, share in zip(self.faults, shares, strict=True):
            kind = FAULTS[fault.kind]
            if isinstance(kind, MachineFault):
                kind.change(numbers, fault.site, float(sizes_of(fault, np.array([share]))[0]))
        return numbers


def _parameters(operation: int, sizes: Array, rate_hz: float, chance: np.random.Generator) -> Array:
    """Return the parameter of an operation at each sample, 0 for no fault, from sizes in SI units, shape (time,)."""
    if operation == alterations.DROPOUT:
        return np.asarray(chance.random(len(sizes)) < sizes, float)
    if operation == alterations.NOISE:
        return sizes - 1.0
    if operation == alterations.DELAY:
        return sizes * rate_hz
    if operation == alterations.LAG:
        # Remaining fraction of a step after one sample; zero without a lag.
        return np.where(sizes > 0.0, np.exp(-1.0 / (rate_hz * np.maximum(sizes, 1e-9))), 0.0)
    return sizes


class SensorCourse:
    """Effect of sensor faults on the observations of one recording.

    Args:
        faults: faults of the scenario. Machine faults are ignored.

    Attributes:
        table: one row per fault, see `edp.sim.sensors.alterations`.
    """

    def __init__(self, faults: Sequence[FaultSpec]) -> None:
        pairs = [(fault, FAULTS[fault.kind]) for fault in faults]
        self._every = [(fault, kind) for fault, kind in pairs if isinstance(kind, SensorFault)]
        self._shown = [(fault, kind) for fault, kind in self._every if kind.operation != alterations.NOISE]
        rows = [(kind.operation, *kind.channels[fault.site], 0)[: alterations.COLUMNS] for fault, kind in self._shown]
        self.table = np.array(rows, dtype=float).reshape(len(rows), alterations.COLUMNS)

    def drawn(self, healthy: Array, rate_hz: float, chance: np.random.Generator) -> Array:
        """Return the random values of a recording with the noise of faults, and one further column per fault.

        Args:
            healthy: random values of `edp.sim.sensors.draws.draw`, shape (time, draws).
            rate_hz: sample rate.
            chance: random generator of the faults.
        """
        if not self._every:
            return healthy
        drawn, columns = healthy.copy(), []
        ticks = np.arange(len(healthy))
        # Each fault has its own generator, so that one fault does not change the random values of another.
        for (fault, kind), child in zip(self._every, chance.spawn(len(self._every)), strict=True):
            sizes = sizes_of(fault, shares_at((fault,), ticks, rate_hz)[:, 0])
            numbers = _parameters(kind.operation, sizes, rate_hz, child)
            if kind.operation == alterations.NOISE:
                for channel in kind.channels[fault.site]:
                    drawn[:, channel] *= 1.0 + numbers
            else:
                columns.append(numbers)
        return np.column_stack((drawn, *columns))
