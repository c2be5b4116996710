"""Mapping from a simulator machine to grey-box parameters, equation by equation.

The grey box (`edp.networks.twin.grey`) has the simulator's equations but for its linkage, so most numbers are the same
in other units. What differs:

- opening curves are polygons with free corners; of the simulator's, k r (0.25 + 0.75 r), the nearest polygon is taken
  (the chords of a convex curve all lie above it);
- a pilot is two equal lags, the simulator's has a damping of 0.9; and each lag behind another one reads where that is
  at the end of a step, so the chain leads by half a step three times. Shares of the lags are those with which spool
  positions of logs agree best; the dead time makes the delay the same;
- pumps ask for and deliver their flow behind the volumetric efficiency, which no log tells apart from it;
- bulk modulus, leakage and viscous friction are those at the oil's temperature of the logs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as grey
from edp.networks.twin.grey.equations import GAMMA
from edp.networks.twin.grey.parameters import ParameterTable
from edp.networks.twin.grey.priors import opening_knots
from edp.sim.machine import layout as sim
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics.valve import PILOT_DAMPING

Doubles = NDArray[np.float64]
PILOT_SHARE, SPOOL_SHARE = 0.86, 0.95
"""Lags of the grey box by 1 / omega of the simulator's filters: least squares on the spools of a family member."""
FINE = 201
"""Points of a spool's travel on which polygons are fitted."""
DEMAND_START, DEMAND_SPAN = 0.1, 0.75
"""Of the simulator's pumps (`edp.sim.physics.pump.demand`): the pilot at which they begin, and its way to full."""


@dataclass(frozen=True, eq=False)
class GreyParts:
    """Mapping from grey-box elements to machine parts.

    Attributes:
        table: parameter table of the grey box.
        primary: valve of each cylinder ``(3,)``.
        conflux: second valve of each cylinder, -1 where it has none.
        reach: full command of each valve as a fraction of the machine's full pilot pressure ``(valve,)``.
        celsius: oil temperature of the logs, degC.
        step_s: step of the grey box's solver, s.
    """

    table: ParameterTable
    primary: tuple[int, int, int]
    conflux: tuple[int, int, int]
    reach: tuple[float, ...]
    celsius: float
    step_s: float = 0.01

    @property
    def fixed(self) -> NDArray[np.bool_]:
        """Mask of grey-box parameters that a machine file lacks or that the simulator fixes, shape ``(number,)``."""
        at, table = np.zeros(len(self.table.numbers), np.bool_), self.table
        at[[table.circuit_at + k for k in (grey.SUPPLY, grey.DEMAND_START, grey.DEMAND_SPAN)]] = True
        at[table.actuator_at + grey.ASYMMETRY] = True
        return at

    @property
    def load(self) -> slice:
        """Numbers of the load: polynomials, of which bodies are found apart."""
        return slice(self.table.inertia_at, len(self.table.numbers))


def grey_numbers(machine: Machine, parts: GreyParts, load: Doubles) -> Doubles:
    """Return the grey-box parameters of a machine, in grey-box units ``(number,)``.

    Args:
        machine: machine of the simulator.
        parts: assignment of elements.
        load: numbers of the load, in units of the grey box, which stay as they are.
    """
    machine = replace(machine, oil=replace(machine.oil, temperature=parts.celsius))
    axes, plant = pack(machine)
    table = parts.table
    si = table.nominal * table.factor
    for i in range(sim.AXES):
        _put_cylinder(si, table.actuator_at[i], axes[i], plant)
        for second, j in enumerate((parts.primary[i], parts.conflux[i])):
            if j >= 0:
                spool = machine, i, bool(second), table.stretches
                _put_valve(si, table.valve_at[j], spool, axes[i], (parts.reach[j], parts.step_s))
    for a in table.pump_at:
        si[a + grey.FLOW] = plant[sim.EFFICIENCY] * plant[sim.MAX_FLOW]
        si[a + grey.LEAST], si[a + grey.LAG] = plant[sim.MIN_DISPLACEMENT], plant[sim.PUMP_TIME]
        si[a + grey.LINE], si[a + grey.RELIEF] = plant[sim.LINE_VOLUME], plant[sim.PUMP_RELIEF]
        si[a + grey.BYPASS], si[a + grey.BYPASS_CLOSED] = plant[sim.BYPASS], plant[sim.BYPASS_CLOSED]
    _put_circuit(si, table.circuit_at, axes, plant, float(np.mean([parts.reach[j] for j in parts.primary])))
    numbers = si / table.factor
    numbers[parts.load] = load
    return np.asarray(numbers)


def _put_cylinder(si: Doubles, a: int, axis: Doubles, plant: Doubles) -> None:
    """Write the parameters of one cylinder from its row in the simulator."""
    same = {
        grey.HEAD_AREA: sim.HEAD_AREA, grey.ROD_AREA: sim.ROD_AREA, grey.HEAD_DEAD: sim.HEAD_DEAD,
        grey.ROD_DEAD: sim.ROD_DEAD, grey.HEAD_RELIEF: sim.RELIEF_HEAD, grey.ROD_RELIEF: sim.RELIEF_ROD,
        grey.CUSHION_LENGTH: sim.CUSHION_LENGTH, grey.CUSHION_LEAST: sim.CUSHION_AREA, grey.COULOMB: sim.COULOMB,
        grey.STRIBECK: sim.STRIBECK, grey.BRISTLE: sim.SIGMA0, grey.BRISTLE_DAMPING: sim.SIGMA1,
        grey.STOP_HIGH: sim.STROKE, grey.STOP_STIFFNESS: sim.STOP_STIFFNESS,
    }  # fmt: skip
    for index, column in same.items():
        si[a + index] = axis[column]
    si[a + grey.PISTON_LEAK] = axis[sim.PISTON_LEAK] * plant[sim.THINNING]
    si[a + grey.SPOOL_LEAK] = axis[sim.HEAD_LEAK] * plant[sim.THINNING]
    si[a + grey.STATIC] = axis[sim.STATIC] - axis[sim.COULOMB]
    si[a + grey.VISCOUS] = axis[sim.VISCOUS] * plant[sim.VISCOUS_SHARE]
    si[a + grey.STOP_LOW] = si[a + grey.ASYMMETRY] = 0.0


def _put_valve(
    si: Doubles,
    places: NDArray[np.int64],
    which: tuple[Machine, int, bool, int],
    axis: Doubles,
    clock: tuple[float, float],
) -> None:
    """Set the parameters of one spool; `which`: machine, cylinder, whether it is the second spool, curve segments.

    `clock` is reach and step.
    """
    machine, i, second, stretches = which
    reach, step_s = clock
    valves = machine.valves
    frequency = (valves.conflux_spool_frequency if second else valves.spool_frequency)[i]
    pilot, spool = (1.0 / (2.0 * np.pi * hertz) for hertz in (valves.pilot_frequency[i], frequency))
    lags = PILOT_SHARE * pilot, SPOOL_SHARE * spool
    dead_time = valves.dead_time[i] + (valves.conflux_extra_dead_time if second else 0.0)
    left = 2.0 * (PILOT_DAMPING * pilot + spool - sum(lags))
    si[places[grey.DELAY]] = dead_time + left + _lead(lags, step_s)
    si[places[grey.PILOT_LAG]], si[places[grey.SPOOL_LAG]] = lags
    if second:
        bands = (sim.CONFLUX_DEAD_BAND_EXTEND, sim.CONFLUX_DEAD_BAND_RETRACT)
        into = (sim.CONFLUX_EXTEND, sim.CONFLUX_RETRACT)
    else:
        bands, into = (sim.DEAD_BAND_EXTEND, sim.DEAD_BAND_RETRACT), (sim.IN_EXTEND, sim.IN_RETRACT)
    out, again = (sim.OUT_EXTEND, sim.OUT_RETRACT), (sim.REGEN_EXTEND, sim.REGEN_RETRACT)
    demand = (sim.DEMAND_EXTEND, sim.DEMAND_RETRACT)
    for d in range(2):
        band = axis[bands[d]]
        si[places[grey.BAND + d]] = band / reach
        si[places[grey.GAIN + d]] = axis[demand[d]]
        curve = _curve(float(band), float(reach), stretches)
        for first, column in ((grey.INTO, into[d]), (grey.OUT_OF, out[d])):
            at = places[first + d]
            if at >= 0:
                si[at : at + len(curve)] = axis[column] * curve
        if places[grey.REGENERATION + d] >= 0:
            si[places[grey.REGENERATION + d]] = axis[again[d]] / axis[out[d]]


@lru_cache(maxsize=256)  # differences by other numbers ask for the same curve thousands of times
def _curve(band: float, reach: float, stretches: int) -> Doubles:
    """Return the increments of the grey box's opening curve for a spool with this dead band and reach."""
    # Where the simulator's spool is: the curve of the grey box counts from its own full command.
    spool = band + (reach - band) * np.linspace(0.0, 1.0, FINE)
    r = np.clip((spool - band) / (1.0 - band), 0.0, 1.0)
    return np.asarray(_polygon(stretches) @ (r * (0.25 + 0.75 * r)))


@lru_cache(maxsize=4)
def _polygon(stretches: int) -> Doubles:
    """Return the increments between the knots of the polygon through zero that is nearest to values on a fine grid."""
    grid, knots = np.linspace(0.0, 1.0, FINE), opening_knots(stretches)
    rising = np.clip((grid[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0)
    return np.asarray(np.linalg.pinv(rising))


def _lead(lags: tuple[float, float], step_s: float) -> float:
    """Time by which the grey box's chain of lags leads: the second lag of the pilot and both of the spool."""
    first, second = lags
    # Means over the two parts of a step; see the delay of a lag that reads the end of each: h / (exp(h / lag) - 1).
    parts = np.array([GAMMA, 1.0 - GAMMA]) * step_s
    half, third = (parts**2).sum() / step_s / 2.0, (parts**3).sum() / step_s / 12.0
    return float(3.0 * half - third * (1.0 / first + 2.0 / second))


def _put_circuit(si: Doubles, c: int, axes: Doubles, plant: Doubles, reach: float) -> None:
    same = {
        grey.BULK: sim.BULK_MODULUS, grey.AIR: sim.AIR, grey.TANK: sim.TANK, grey.MAKE_UP: sim.ANTI_CAVITATION,
        grey.PORT_SLOPE: sim.PORT_SLOPE, grey.RELIEF_SLOPE: sim.RELIEF_SLOPE,
    }  # fmt: skip
    for index, column in same.items():
        si[c + index] = plant[column]
    si[c + grey.POWER] = plant[sim.EFFICIENCY] * plant[sim.POWER_LIMIT]
    si[c + grey.PLAY] = axes[0, sim.HYSTERESIS] / reach
    si[c + grey.DEMAND_START], si[c + grey.DEMAND_SPAN] = DEMAND_START / reach, DEMAND_SPAN / reach
