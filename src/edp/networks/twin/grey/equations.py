"""Equations of a grey box: command path, pumps, hydraulic network, load and friction.

The equations use an `Algebra`. The same code therefore evaluates numbers, expressions that are differentiated and
compiled (`edp.networks.twin.symbolic`), and symbols of CasADi. Units are m, s, MPa, MN and Gg. Pressures are gauge
pressures.

The nodes of the hydraulic network are the head chambers of all actuators, their rod chambers, the pump lines, the tank
and the supply. The pressures of tank and supply are constant. The unknowns y of an implicit step are the other
pressures, followed by the velocities of the actuators.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from edp.networks.twin.grey import parameter_index as at

SMOOTH2 = 0.1**2
"""Square of the pressure difference below which orifice flow becomes laminar, MPa^2."""
CHECK = 1e-3
"""Backward flow of a load check valve as a fraction of its forward flow. It is above zero, so that a closed valve has a
derivative."""
IDLE = 1e-9
"""Minimum pump power in a denominator, MW."""
MISSING = 65535
"""Missing entry in arrays of unsigned integers."""
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Coefficient of the SDIRK method for L-stability with the smaller error constant."""
Values = Sequence[Any]


class Algebra(Protocol):
    """Operations that the equations use in addition to ``+ - * /``."""

    def sqrt(self, a: Any) -> Any:
        """Return the square root."""
        ...

    def exp(self, a: Any) -> Any:
        """Return e to the power of `a`."""
        ...

    def tanh(self, a: Any) -> Any:
        """Return the hyperbolic tangent."""
        ...

    def sin(self, a: Any) -> Any:
        """Return the sine."""
        ...

    def cos(self, a: Any) -> Any:
        """Return the cosine."""
        ...

    def less(self, a: Any, b: Any, then: Any, otherwise: Any) -> Any:
        """Return `then` where a < b, else `otherwise`."""
        ...

    def derivatives(self, results: Values, variables: Values) -> list[list[Any]]:
        """Return the derivatives of results by variables, a row for each result."""
        ...


@dataclass(frozen=True)
class GreyForm:
    """Structure of a machine: its elements, their connections, and the positions of their parameters.

    Attributes:
        valve_at: positions of the parameters of each valve, see `edp.networks.twin.grey.parameter_index`; -1 if a valve
            does not have the parameter.
        valve_actuator: actuator of each valve.
        valve_pump: pump of each valve; -1 for the supply.
        actuator_at: position of the first parameter of each actuator.
        pump_at: position of the first parameter of each pump.
        circuit_at: position of the first parameter of the circuit.
        inertia_at: position of the first parameter of the load.
        inertia_terms: number of coefficients per entry of the inertia's root; 0 for a known linkage.
        potential_at: position of the first coefficient of the potential.
        exponents: exponents of the monomials of the load.
        joint_actuators: actuator of each joint of a known linkage; empty for a polynomial load.
        knots: knots of the opening curves.
        parameters: number of parameters.
    """

    valve_at: tuple[tuple[int, ...], ...]
    valve_actuator: tuple[int, ...]
    valve_pump: tuple[int, ...]
    actuator_at: tuple[int, ...]
    pump_at: tuple[int, ...]
    circuit_at: int
    inertia_at: int
    inertia_terms: int
    potential_at: int
    exponents: tuple[tuple[int, ...], ...]
    joint_actuators: tuple[int, ...]
    knots: tuple[float, ...]
    parameters: int

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, NDArray[Any]], linkage: Any, circuit_at: int, load: tuple[int, int, int]
    ) -> GreyForm:
        """Build the form from arrays of integers, in which a missing entry is negative or `MISSING`.

        Args:
            arrays: ``valve_at``, ``valve_actuator``, ``valve_pump``, ``actuator_at``, ``pump_at``, ``exponents``,
                ``knots`` and ``numbers``, by name.
            linkage: see `edp.networks.twin.grey.parameter_index`; at most one entry for a polynomial load.
            circuit_at: position of the first parameter of the circuit.
            load: ``inertia_at``, ``inertia_terms`` and ``potential_at``.
        """

        def row(values: Any) -> tuple[int, ...]:
            return tuple(-1 if value < 0 or value == MISSING else int(value) for value in values)

        inertia_at, inertia_terms, potential_at = load
        return GreyForm(
            valve_at=tuple(map(row, arrays["valve_at"])),
            valve_actuator=row(arrays["valve_actuator"]),
            valve_pump=row(arrays["valve_pump"]),
            actuator_at=row(arrays["actuator_at"]),
            pump_at=tuple(first for first in row(arrays["pump_at"]) if first >= 0),
            circuit_at=int(circuit_at),
            inertia_at=int(inertia_at),
            inertia_terms=int(inertia_terms),
            potential_at=int(potential_at),
            exponents=tuple(map(row, arrays["exponents"])),
            joint_actuators=row(linkage[at.JOINTS + at.ACTUATOR :: at.JOINT_VALUES]),
            knots=tuple(map(float, arrays["knots"])),
            parameters=len(arrays["numbers"]),
        )

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return len(self.actuator_at)

    @property
    def valves(self) -> int:
        """Number of valves."""
        return len(self.valve_at)

    @property
    def pumps(self) -> int:
        """Number of pumps."""
        return len(self.pump_at)

    @property
    def nodes(self) -> int:
        """Number of unknown pressures."""
        return 2 * self.actuators + self.pumps

    @property
    def unknowns(self) -> int:
        """Number of unknowns of an implicit step."""
        return self.nodes + self.actuators

    @property
    def constants(self) -> int:
        """Number of constants: middle and scale of the strokes, gravity, and lengths of the first two bodies."""
        return 2 * self.actuators + 3


class Equations:
    """Equations of one machine.

    Args:
        form: structure of the machine.
        parameters: parameters as numbers or symbols, in the order of `edp.networks.twin.grey.parameter_index`.
        constants: middle and scale of the strokes, gravity (m/s^2), lengths of the first two bodies (m).
        algebra: operations on numbers or symbols.
    """

    def __init__(self, form: GreyForm, parameters: Values, constants: Values, algebra: Algebra) -> None:
        self.form, self.q, self.algebra = form, parameters, algebra
        n = form.actuators
        self.middle, self.scale = constants[:n], constants[n : 2 * n]
        self.gravity, self.lengths = constants[2 * n], constants[2 * n + 1 :]
        self.circuit = parameters[form.circuit_at : form.circuit_at + at.CIRCUIT_VALUES]
        self.actuator = [parameters[first : first + at.ACTUATOR_VALUES] for first in form.actuator_at]
        self.pump = [parameters[first : first + at.PUMP_VALUES] for first in form.pump_at]

    def _least(self, a: Any, b: Any) -> Any:
        return self.algebra.less(a, b, a, b)

    def _largest(self, a: Any, b: Any) -> Any:
        return self.algebra.less(a, b, b, a)

    def _clip(self, a: Any, low: Any, high: Any) -> Any:
        return self._least(self._largest(a, low), high)

    def _valve(self, j: int, which: int) -> Any:
        return self.q[self.form.valve_at[j][which]]

    # --- Command path ---

    def lag_factors(self, j: int, step: Any) -> list[Any]:
        """Return the decay factors of the pilot lag and the spool lag of a valve over `step` seconds."""
        return [self.algebra.exp(-step / self._valve(j, which)) for which in (at.PILOT_LAG, at.SPOOL_LAG)]

    def advance_valve(self, state: Values, command: Any, lag_factors: Values) -> list[Any]:
        """Return the state of a valve after a time: two pilot lags, play, two spool lags.

        Args:
            state: first and second pilot lag, play, first and second spool lag, as fractions of full travel.
            command: command one dead time ago, as a fraction of full travel.
            lag_factors: decay factors of the time step.
        """
        play, (pilot_part, spool_part) = self.circuit[at.PLAY], lag_factors
        first = command + (state[at.PILOT_1] - command) * pilot_part
        pilot = first + (state[at.PILOT_2] - first) * pilot_part
        played = self._clip(state[at.PLAYED], pilot - play, pilot + play)
        behind = played + (state[at.SPOOL_1] - played) * spool_part
        return [first, pilot, played, behind, behind + (state[at.SPOOL] - behind) * spool_part]

    def displacements(self, before: Values, pilots: Values, pressures: Values, step: Any) -> list[Any]:
        """Return the pump displacements after `step` seconds under the common power limit.

        Args:
            before: displacements as fractions of full displacement.
            pilots: pilot positions of all valves.
            pressures: pressures of the pump lines, MPa.
            step: time step, s.
        """
        start, span = self.circuit[at.DEMAND_START], self.circuit[at.DEMAND_SPAN]
        demands, power = [], 0.0
        for m, pump in enumerate(self.pump):
            demand = pump[at.LEAST]
            for j in range(self.form.valves):
                if self.form.valve_pump[j] == m:
                    pilot = pilots[j]
                    size = self.algebra.less(pilot, 0.0, -pilot, pilot)
                    gain = self.algebra.less(pilot, 0.0, self._valve(j, at.GAIN + 1), self._valve(j, at.GAIN))
                    share = self._least(gain * self._clip((size - start) / span, 0.0, 1.0), 1.0)
                    demand = self._largest(demand, share)
            demands.append(demand)
            power = power + pump[at.FLOW] * demand * self._largest(pressures[m], 0.0)
        limit = self._least(1.0, self.circuit[at.POWER] / self._largest(power, IDLE))
        after = []
        for m, pump in enumerate(self.pump):
            goal = demands[m] * limit
            after.append(goal + (before[m] - goal) * self.algebra.exp(-step / pump[at.LAG]))
        return after

    # --- Load ---

    def load(self, strokes: Values, velocities: Values, joints: Values) -> tuple[list[list[Any]], list[Any]]:
        """Return the inertia matrix and the forces of gravity and motion by Lagrange's equations.

            M(s) v' + c(s, v) + grad U(s) = forces

        Args:
            strokes: strokes of the actuators, m.
            velocities: velocities of the actuators, m/s.
            joints: joint angles of a known linkage as functions of the strokes, rad.
        """
        if self.form.joint_actuators:
            mass, potential = self._bodies(self.moments(), joints, strokes)
        else:
            mass, potential = self._polynomials(strokes)
        return mass, self._forces(mass, potential, strokes, velocities)

    def balance(
        self, moments: Values, strokes: Values, velocities: Values, accelerations: Values, joints: Values
    ) -> list[Any]:
        """Return the forces of a motion on the actuators, M v' + c + grad U, for given `moments`."""
        mass, potential = self._bodies(moments, joints, strokes)
        forces, n = self._forces(mass, potential, strokes, velocities), self.form.actuators
        return [forces[i] + sum((mass[i][k] * accelerations[k] for k in range(n)), 0.0) for i in range(n)]

    def _forces(self, mass: list[list[Any]], potential: Any, strokes: Values, velocities: Values) -> list[Any]:
        n = self.form.actuators
        momentum = [sum((mass[i][k] * velocities[k] for k in range(n)), 0.0) for i in range(n)]
        energy = 0.5 * sum((momentum[i] * velocities[i] for i in range(n)), 0.0)
        turning = self.algebra.derivatives(momentum, strokes)
        (by_energy, by_potential) = self.algebra.derivatives([energy, potential], strokes)
        forces = []
        for i in range(n):
            rate = sum((turning[i][k] * velocities[k] for k in range(n)), 0.0)
            forces.append(by_potential[i] + rate - by_energy[i])
        return forces

    def _polynomials(self, strokes: Values) -> tuple[list[list[Any]], Any]:
        """Return inertia L L' and potential as polynomials of the strokes."""
        form, n = self.form, self.form.actuators
        z = [(s - middle) * scale for s, middle, scale in zip(strokes, self.middle, self.scale, strict=True)]
        terms: list[Any] = []
        for exponents in form.exponents:
            term: Any = 1.0
            for value, exponent in zip(z, exponents, strict=True):
                for _ in range(exponent):
                    term = term * value
            terms.append(term)
        first, root = form.inertia_at, [[0.0] * n for _ in range(n)]
        for a in range(n):
            for c in range(a + 1):
                coefficients = self.q[first : first + form.inertia_terms]
                root[a][c] = sum((q * term for q, term in zip(coefficients, terms, strict=False)), 0.0)
                first += form.inertia_terms
        mass = [[sum((root[i][c] * root[k][c] for c in range(n)), 0.0) for k in range(n)] for i in range(n)]
        coefficients = self.q[form.potential_at : form.potential_at + len(terms) - 1]
        return mass, sum((q * term for q, term in zip(coefficients, terms[1:], strict=True)), 0.0)

    def moments(self) -> list[Any]:
        """Return the moments X, Y and the inertia H of each body about its joint.

        Inertia and potential are linear in these.

            X_a = m_a x_a + L_a m,   Y_a = m_a y_a,   H_a = I_a + m_a (x_a^2 + y_a^2) + L_a^2 m

        m is the mass of all bodies further from the base.
        """
        body = [self.q[self.form.inertia_at + at.BODY_VALUES * b :][: at.BODY_VALUES] for b in range(at.BODIES)]
        moments: list[Any] = []
        for b, (mass, x, y, inertia) in enumerate(body):
            behind = sum((other[at.MASS] for other in body[b + 1 :]), 0.0)
            length = self.lengths[b] if b + 1 < at.BODIES else 0.0
            moments += [mass * x + length * behind, mass * y]
            moments.append(inertia + mass * (x * x + y * y) + length * length * behind)
        return moments

    def _bodies(self, moments: Values, joints: Values, strokes: Values) -> tuple[list[list[Any]], Any]:
        """Return inertia and potential of planar bodies in a row, with one actuator per joint."""
        count, n = at.BODIES, self.form.actuators
        angles: list[Any] = []
        for joint in joints:
            angles.append(joint if not angles else angles[-1] + joint)
        sines, cosines = [self.algebra.sin(a) for a in angles], [self.algebra.cos(a) for a in angles]
        coupled: list[list[Any]] = [[0.0] * count for _ in range(count)]
        potential: Any = 0.0
        for b in range(count):
            x, y, coupled[b][b] = moments[3 * b : 3 * b + 3]
            potential = potential + self.gravity * (x * sines[b] + y * cosines[b])
            for a in range(b):
                cosine = cosines[b] * cosines[a] + sines[b] * sines[a]
                sine = sines[b] * cosines[a] - cosines[b] * sines[a]
                coupled[a][b] = coupled[b][a] = self.lengths[a] * (x * cosine - y * sine)
        turn = self.algebra.derivatives(angles, strokes)
        moved = [[sum((coupled[a][b] * turn[b][k] for b in range(count)), 0.0) for k in range(n)] for a in range(count)]
        inertia = [[sum((turn[a][i] * moved[a][k] for a in range(count)), 0.0) for k in range(n)] for i in range(n)]
        return inertia, potential

    # --- Hydraulic network and motion ---

    def contents(self, pressures: Values) -> list[Any]:
        """Return the oil content of each node as a pressure: p - B a p_0 / p_abs.

        The content is the pressure of the same amount of oil without free air. Its derivative by p is the ratio of the
        bulk modulus B and the effective bulk modulus of oil with isothermal free air. The content increases with p
        everywhere, so that Newton's method also converges near cavitation.
        """
        air = self.circuit[at.BULK] * self.circuit[at.AIR] * at.ATMOSPHERE
        contents = []
        for p in pressures:
            absolute = p + at.ATMOSPHERE
            # Continue along the tangent below the minimum pressure: a pole there would stop the iteration.
            inverse = 1.0 / self._largest(absolute, at.LEAST_ABSOLUTE)
            contents.append(p - air * (inverse * (2.0 - absolute * inverse)))
        return contents

    def net_flows(self, pressures: Values, spools: Values, displacements: Values, strokes: Values) -> list[Any]:
        """Return the net flow into each node except tank and supply; Q = a dp / (dp^2 + delta^2)^(1/4)."""
        p = [*pressures, self.circuit[at.TANK], self.circuit[at.SUPPLY]]
        net: list[Any] = [0.0] * len(p)

        def edge(start: int, end: int, area: Any, checked: bool = False) -> None:
            flow = area * self._turbulent(p[start] - p[end])
            if checked:
                flow = self.algebra.less(p[start], p[end], CHECK * flow, flow)
            net[start], net[end] = net[start] - flow, net[end] + flow

        for j in range(self.form.valves):
            for side in range(2):
                self._spool(j, side, spools[j], strokes, edge)
        n, tank = self.form.actuators, len(p) - 2
        for i in range(n):
            leak = self.actuator[i][at.PISTON_LEAK] * (p[i] - p[n + i])
            net[i], net[n + i] = net[i] - leak, net[n + i] + leak
            for side in range(2):
                k = i + side * n
                lost = self.actuator[i][at.SPOOL_LEAK] * (p[k] - p[tank])
                # Let the pressure rise while a relief valve opens, as real valves do.
                over = self._largest(p[k] - self.actuator[i][at.HEAD_RELIEF + side], 0.0)
                lost = lost + self.circuit[at.PORT_SLOPE] * over
                fed = self.circuit[at.MAKE_UP] * self._turbulent(self._largest(p[tank] - p[k], 0.0))
                net[k] = net[k] + fed - lost
        for m, pump in enumerate(self.pump):
            k = 2 * n + m
            edge(k, tank, self._open_centre(m, spools))
            over = self._largest(p[k] - pump[at.RELIEF], 0.0)
            net[k] = net[k] + pump[at.FLOW] * displacements[m] - self.circuit[at.RELIEF_SLOPE] * over
        return net[: self.form.nodes]

    def _turbulent(self, dp: Any) -> Any:
        return dp / self.algebra.sqrt(self.algebra.sqrt(dp * dp + SMOOTH2))

    def _open_centre(self, m: int, spools: Values) -> Any:
        """Return the open-centre area of a pump; each moving spool reduces it."""
        area = self.pump[m][at.BYPASS]
        for j in range(self.form.valves):
            if self.form.valve_pump[j] == m:
                size = self.algebra.less(spools[j], 0.0, -spools[j], spools[j])
                left = self._largest(1.0 - size / self.pump[m][at.BYPASS_CLOSED], 0.0)
                area = area * (left * left)
        return area

    def _spool(self, j: int, side: int, x: Any, strokes: Values, edge: Any) -> None:
        """Add the openings of one spool in one direction."""
        form, n = self.form, self.form.actuators
        i, pump, places = form.valve_actuator[j], form.valve_pump[j], form.valve_at[j]
        band, tank = self._valve(j, at.BAND + side), form.nodes
        r = self._clip(((x if side == 0 else -x) - band) / (1.0 - band), 0.0, 1.0)
        fed, other = (i, n + i) if side == 0 else (n + i, i)
        edge(2 * n + pump if pump >= 0 else tank + 1, fed, self._opening(r, places[at.INTO + side]), True)
        if places[at.OUT_OF + side] < 0:
            return
        # Throttle the outflow by the cushion on the side that the piston approaches.
        actuator = self.actuator[i]
        left = actuator[at.STOP_HIGH] - strokes[i] if side == 0 else strokes[i] - actuator[at.STOP_LOW]
        near, least = self._clip(left / actuator[at.CUSHION_LENGTH], 0.0, 1.0), actuator[at.CUSHION_LEAST]
        area = self._opening(r, places[at.OUT_OF + side])
        area = area * (least + (1.0 - least) * (near * near * (3.0 - 2.0 * near)))
        edge(other, tank, area)
        if places[at.REGENERATION + side] >= 0:
            edge(other, fed, area * self._valve(j, at.REGENERATION + side), True)

    def _opening(self, r: Any, first: int) -> Any:
        """Return the area of a monotone opening curve at r in [0, 1], as a sum of increments between knots."""
        knots, area = self.form.knots, 0.0
        for k in range(len(knots) - 1):
            share = self._clip((r - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)
            area = area + self.q[first + k] * share
        return area

    def friction(self, i: int, v: Any, before: Any, step: Any) -> tuple[Any, Any]:
        """Return bristle deflection and force of LuGre friction after an implicit step.

        Args:
            i: index of the actuator.
            v: velocity at the end of the step, m/s.
            before: deflection at the start of the step, m.
            step: time step, s.
        """
        a = self.actuator[i]
        ratio = v / a[at.STRIBECK]
        fade = self.algebra.exp(-(ratio * ratio))
        level = a[at.COULOMB] + a[at.STATIC] * fade
        speed = self.algebra.less(v, 0.0, -v, v)
        # The implicit step: z = before + step (v - stiffness |v| z / level).
        z = (before + step * v) / (1.0 + a[at.BRISTLE] * step * speed / level)
        damping = a[at.BRISTLE_DAMPING] * fade / step
        force = a[at.BRISTLE] * z + damping * (z - before) + a[at.VISCOUS] * v
        # Add a force that acts in one direction of motion only, smooth over the Stribeck velocity.
        tilt = self.algebra.tanh(ratio)
        return z, force + a[at.ASYMMETRY] * (tilt * tilt)

    def stage(
        self, y: Values, stage: Stage, mass: list[list[Any]], forces: Values, contents: Values | None = None
    ) -> list[Any]:
        """Return the residual of an implicit stage of an L-stable SDIRK method of order two (Alexander 1977).

            c(p) - b_c - d B / V (net flow - A v) = 0,   M (v - b_v) - d (pressure forces - friction - load - stop) = 0

        Args:
            y: unknowns.
            stage: inputs of the stage.
            mass: inertia matrix.
            forces: forces of gravity and motion against the actuators.
            contents: contents of the nodes at these unknowns; None to compute them.
        """
        n, nodes, step = self.form.actuators, self.form.nodes, stage.step
        p, v = y[:nodes], y[nodes:]
        net = self.net_flows(p, stage.spools, stage.displacements, stage.strokes)
        filled = self.contents(p) if contents is None else contents
        rows = []
        for k in range(nodes):
            into = net[k]
            if k < 2 * n:
                i, side = k % n, k // n
                actuator, way = self.actuator[i], (1.0, -1.0)[side]
                area = actuator[at.HEAD_AREA + side]
                # Use the dead volume alone beyond an end stop.
                room = self._largest(way * (stage.strokes[i] - actuator[at.STOP_LOW + side]), 0.0)
                volume, into = actuator[at.HEAD_DEAD + side] + area * room, into - way * area * v[i]
            else:
                volume = self.pump[k - 2 * n][at.LINE]
            rows.append(filled[k] - stage.base[k] - step * self.circuit[at.BULK] / volume * into)
        change = [v[i] - stage.base[nodes + i] for i in range(n)]
        for i in range(n):
            actuator = self.actuator[i]
            push = actuator[at.HEAD_AREA] * p[i] - actuator[at.ROD_AREA] * p[n + i] - forces[i]
            reached = stage.reached[i] + stage.half * v[i]
            depth = self._least(reached - actuator[at.STOP_LOW], 0.0)
            depth = depth + self._largest(reached - actuator[at.STOP_HIGH], 0.0)
            rubbing = self.friction(i, v[i], stage.bristles[i], step)[1]
            inertial = sum((mass[i][k] * change[k] for k in range(n)), 0.0)
            rows.append(inertial - step * (push - rubbing - actuator[at.STOP_STIFFNESS] * depth))
        return rows


@dataclass(frozen=True)
class Stage:
    """Inputs of an implicit stage.

    Attributes:
        base: contents and velocities at the start of the stage.
        bristles: bristle deflections at the start of the stage, m.
        spools: spool positions as fractions of full travel.
        displacements: pump displacements as fractions of full displacement.
        strokes: strokes in the middle of the step, m.
        reached: strokes at the end of the stage, without the contribution of the unknown velocities, m.
        half: half of the time from the start of the step to the end of the stage, s.
        step: length of the stage, s.
    """

    base: Values
    bristles: Values
    spools: Values
    displacements: Values
    strokes: Values
    reached: Values
    half: Any
    step: Any
