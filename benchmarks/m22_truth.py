"""Which signals of Table A.1 matter to the velocities ahead, asked of the simulator and not of its logs.

At moments of simulated recordings one quantity is pushed off its value, everything else is left as it is, and the
simulation runs on under the same lever targets. A channel is a *cause* if the push of the quantity that it measures
changes some cylinder's velocity by more than the sensors' noise. A channel that is no quantity of the plant but is
computed from others as it is logged (the acceleration, from the velocity) is none.

A cause is *needed* where no law of the simulator gives it from the other channels: the demand of a conflux spool is a
function of the primary demand at the same tick (`edp.sim.physics.valve.shape_demand`), so a network can do without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.sim import Scenario, load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import linkage
from edp.sim.sensors import filters
from edp.sim.simulate import Simulation

Array = NDArray[np.float64]
PILOTS = ("BmUp", "BmDwn", "AmIn", "AmOut", "BktIn", "BktOut")
PRESSURES = {f"CylPressures_{n}": at.HEAD + n - 1 for n in (1, 2, 3)} | {
    f"CylPressures_{n}": at.ROD + n - 5 for n in (5, 6, 7)
}
AHEAD = 50
"""Samples within which a push must show."""
SHARE = 0.25
"""Size of a push, as a share of the range between the channel's 0.5 % and 99.5 % quantiles."""
EXACT = 1e-3
"""Largest rms deviation, over the channel's own, of a law that is said to give a channel."""


@dataclass(frozen=True)
class Cause:
    """What a push of one channel's quantity does.

    Attributes:
        name: of the channel.
        push: its size, SI unit.
        effect_mm_s: largest change of velocity by cylinder, root mean square over the moments.
        matters: whether one of them exceeds the noise of the velocity sensors.
        given_by: the channels that give it by a law of the simulator; empty where none do.
    """

    name: str
    push: float
    effect_mm_s: tuple[float, ...]
    matters: bool
    given_by: tuple[str, ...]

    @property
    def needed(self) -> bool:
        """Whether a feature set without it has lost something."""
        return self.matters and not self.given_by


def causes(plan: Sequence[Scenario], recordings: Sequence[Recording], moments: int = 4, seed: int = 0) -> list[Cause]:
    """Every channel of Table A.1 pushed at `moments` moments of each scenario of one machine.

    Args:
        plan: the scenarios.
        recordings: their recordings, for the size of the pushes and the laws.
        moments: by scenario.
        seed: of their times.
    """
    machine = load_machine(plan[0].machine)
    pushes = {name: _range(recordings, name) * SHARE for name in TABLE_A1}
    rng = np.random.default_rng(seed)
    changes: dict[str, list[Array]] = {name: [] for name in TABLE_A1}
    for scenario in plan:
        simulation = Simulation(scenario)
        latest = scenario.samples - AHEAD
        for moment in np.sort(rng.integers(latest // 8, latest, moments)):
            simulation.run(max(0, int(moment) - simulation.samples))
            for name, change in _moment(simulation, pushes).items():
                changes[name].append(change)
    found = []
    for name in TABLE_A1:
        effect = 1e3 * np.sqrt(np.mean(np.square(changes[name]), axis=0))
        matters = bool(effect.max() > 1e3 * machine.sensors.velocity)
        found.append(Cause(name, pushes[name], tuple(map(float, effect)), matters, _given_by(name, recordings)))
    return found


def _range(recordings: Sequence[Recording], name: str) -> float:
    low, high = np.quantile(np.concatenate([r.column(name) for r in recordings]), [0.005, 0.995])
    return float(high - low)


def _moment(simulation: Simulation, pushes: dict[str, float]) -> dict[str, Array]:
    """Largest change of each velocity (m/s) after each push at the present moment, which is left as it was."""
    start = simulation.snapshot()
    undisturbed = simulation.run(AHEAD)[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    commands = simulation.targets[-AHEAD:]
    found = {}
    for name, size in pushes.items():
        simulation.restore(start)
        _push(simulation, name, size)
        rows = simulation.follow(commands)[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
        # The pushed velocity itself is no effect at the tick of the push.
        found[name] = np.abs(rows - undisturbed)[1:].max(axis=0)
    simulation.restore(start)
    return found


def _push(simulation: Simulation, name: str, size: float) -> None:
    """Move the quantity that a channel measures; nothing where the plant has none."""
    plant = simulation.plant
    state, _, _, waiting = plant.memory[:4]
    if name.startswith("CylVels_"):
        axis = int(name[-1]) - 1
        lever = linkage.cylinder(axis, state[at.PSI + axis], pack(simulation.machine)[1])[1]
        state[at.RATE + axis] += size / lever
    elif name in PRESSURES:
        state[PRESSURES[name]] += size
    elif name.removesuffix("Conf") in PILOTS:
        # Demands that are still in the dead time, so a push of some samples' length.
        number = PILOTS.index(name.removesuffix("Conf"))
        spool = number // 2 + (at.AXES if name.endswith("Conf") else 0)
        share = size / simulation.machine.valves.pilot_pressure
        held, sign = waiting[:, spool], 1.0 - 2.0 * (number % 2)
        # Where the other side is under pressure, a push of this one would close the spool: that is not its effect.
        held[:] = np.where(sign * held >= 0.0, held + sign * share, held)


def _given_by(name: str, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the channels that determine `name` by an equation of the simulator, checked on the logs."""
    machine = load_machine(str(recordings[0].meta["machine"]))
    if name.startswith("CylAcc_"):
        source = name.replace("Acc", "Vels")
        band = machine.sensors.acceleration_bandwidth
        made = [
            filters.filtered_derivative(r.select([source]).astype(float), band, r.rate_hz)[:, 0] for r in recordings
        ]
    elif name.endswith("Conf"):
        source = name.removesuffix("Conf")
        number, (_, plant) = PILOTS.index(source), pack(machine)
        shares = (machine.valves.conflux_extend, machine.valves.conflux_retract)[number % 2]
        full, start = machine.valves.pilot_pressure, plant[at.CONFLUX_START]
        sizes = [r.column(source).astype(float) / full for r in recordings]
        made = [full * shares[number // 2] * np.maximum((s - start) / (1 - start), 0) for s in sizes]
    else:
        return ()
    truth = np.concatenate([r.column(name).astype(float) for r in recordings])
    error = np.concatenate(made) - truth
    return (source,) if error.std() <= EXACT * truth.std() else ()
