"""One tick of a grey box for CasADi: pumps, valves, cylinders, motors and their load. Needs NumPy and CasADi.

Each implicit stage is the root of its residual, which CasADi's Newton method finds; derivatives of any order follow
from the implicit function theorem. A stage whose root is not found answers NaN. Units are m, s, MPa, MN and Gg.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

NONE = 65535
"""Entry of a table of places: there is no such thing."""
ATMOSPHERE, LEAST_ABSOLUTE = 0.1013, 1e-3
SMOOTH2, CHECK, IDLE = 0.1**2, 1e-3, 1e-9
GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
AHEAD = (1.0 - GAMMA) / GAMMA
BEYOND = 1.0
ROOT = {"abstolStep": 1e-9, "max_iter": 60, "error_on_fail": False}
"""Of Newton's method: far below the rounding of single precision, in MPa and m/s."""
LEFT = 1e-6
"""Of a residual that is taken for a root, in MPa and Gg m/s."""
DAMPED, LEAST_SHARE = 40, 0.125
"""Steps of a second search, and the least share of one that is taken."""

# Places behind the first one of an actuator, a pump, the circuit; of a valve's numbers; of a body's.
(
    HEAD_AREA, ROD_AREA, HEAD_DEAD, ROD_DEAD, PISTON_LEAK, SPOOL_LEAK, HEAD_RELIEF, ROD_RELIEF,
    CUSHION_LENGTH, CUSHION_LEAST, COULOMB, STATIC, STRIBECK, VISCOUS, BRISTLE, BRISTLE_DAMPING,
    STOP_LOW, STOP_HIGH, STOP_STIFFNESS, ASYMMETRY,
) = range(20)  # fmt: skip
FLOW, LEAST, LAG, LINE, BYPASS, BYPASS_CLOSED, RELIEF = range(7)
(
    BULK, AIR, TANK, SUPPLY, MAKE_UP, PORT_SLOPE, RELIEF_SLOPE, POWER, PLAY, DEMAND_START, DEMAND_SPAN,
) = range(11)  # fmt: skip
DELAY, PILOT_LAG, SPOOL_LAG, BAND, GAIN, INTO, OUT_OF, REGENERATION = 0, 1, 2, 3, 5, 7, 9, 11
PILOT_1, PILOT_2, PLAYED, SPOOL_1, SPOOL = range(5)
BODIES, KNOTS, KNOT_VALUES = 3, 33, 4
MASS, CENTRE_X, CENTRE_Y, INERTIA = range(4)


def turbulent(dp: Any) -> Any:
    """Smoothed square root of a pressure difference."""
    return dp / ca.sqrt(ca.sqrt(dp * dp + SMOOTH2))


class HydraulicMachine:
    """Constants of one machine, and the functions that make up a time step.

    Args:
        layer: what the layer is besides its arrays.
        w: its arrays by name.
    """

    def __init__(self, layer: dict[str, Any], w: Mapping[str, np.ndarray]) -> None:
        self.w = {name: np.asarray(values, dtype=float) for name, values in w.items()}
        places = ("valve_at", "valve_actuator", "valve_pump", "actuator_at", "pump_at", "ports", "exponents", "sides")
        self.at = {name: np.asarray(w[name]).astype(int) for name in places}
        self.q, self.circuit_at, self.load_at = self.w["numbers"], layer["circuit"], layer["load"]
        self.tick_s, self.steps, self.remembered = layer["tick_s"], layer["steps"], layer["remembered"]
        self.n, self.valves = len(self.at["actuator_at"]), len(self.w["full"])
        self.pumps = int((self.at["pump_at"] != NONE).sum())
        self.nodes = 2 * self.n + self.pumps
        self.unknown, self.linked = self.nodes + self.n, len(self.w["linkage"]) > 1
        q = [float(value) for value in self.q]
        self.circuit = q[self.circuit_at :]
        self.actuator = [q[first:] for first in self.at["actuator_at"]]
        self.pump = [q[first:] for first in self.at["pump_at"][: self.pumps]]
        self.valve = [[q[k] if k != NONE else math.nan for k in row] for row in self.at["valve_at"]]
        self.air = max(self.circuit[BULK] * self.circuit[AIR] * ATMOSPHERE, 1e-9)
        step = self.tick_s / self.steps
        self.moved = np.where(self.w["scale"] > 0.0, 1.0, 0.0)
        self.load = self._load_function()
        self.advance = [self._advance_function(length) for length in (GAMMA * step, step - GAMMA * step)]
        self.displaced = self._displaced_function(step)
        self.root, self.left = self._stage(GAMMA * step)
        self.bristles = self._bristle_function(GAMMA * step)

    def demands(self, commands: Any) -> Any:
        """Return the signed commands of the valves as fractions of full scale, extension positive."""
        parts = []
        for j, (extend, retract) in enumerate(self.at["sides"]):
            signed = commands[int(extend)] - (commands[int(retract)] if retract != NONE else 0.0)
            share = signed / float(self.w["full"][j])
            # Limits would swallow what is no number.
            parts.append(ca.if_else(ca.fabs(share) < math.inf, ca.fmin(ca.fmax(share, -1.0), 1.0), math.nan))
        return ca.vertcat(*parts)

    def _advance_function(self, step: float) -> ca.Function:
        """Dead time, two lags of the pilot, play, two lags of the spool: states of the valves, a column each."""
        rows, history = ca.SX.sym("rows", 5, self.valves), ca.SX.sym("history", self.valves, self.remembered)
        play, columns = self.circuit[PLAY], []
        for j in range(self.valves):
            ticks = min(max(self.valve[j][DELAY] / self.tick_s, 0.0), history.shape[1] - 2.0)
            whole = min(int(ticks), history.shape[1] - 2)
            goal = history[j, whole] + (ticks - whole) * (history[j, whole + 1] - history[j, whole])
            keep = math.exp(-step / self.valve[j][PILOT_LAG])
            first = goal + (rows[PILOT_1, j] - goal) * keep
            pilot = first + (rows[PILOT_2, j] - first) * keep
            played = ca.fmin(ca.fmax(rows[PLAYED, j], pilot - play), pilot + play)
            keep = math.exp(-step / self.valve[j][SPOOL_LAG])
            behind = played + (rows[SPOOL_1, j] - played) * keep
            columns.append(ca.vertcat(first, pilot, played, behind, behind + (rows[SPOOL, j] - behind) * keep))
        return ca.Function("advance", [rows, history], [ca.horzcat(*columns)])

    def _displaced_function(self, step: float) -> ca.Function:
        """Return the function for the pump displacements: pilot demands under the common power limit."""
        d, rows, p = ca.SX.sym("d", self.pumps), ca.SX.sym("rows", 5, self.valves), ca.SX.sym("p", self.pumps)
        start, span = self.circuit[DEMAND_START], self.circuit[DEMAND_SPAN]
        asked, power = [], ca.SX(0.0)
        for m in range(self.pumps):
            most = ca.SX(self.pump[m][LEAST])
            for j in np.flatnonzero(self.at["valve_pump"] == m):
                pilot = rows[PILOT_2, int(j)]
                r = ca.fmin(ca.fmax((ca.fabs(pilot) - start) / span, 0.0), 1.0)
                gain = ca.if_else(pilot >= 0.0, self.valve[int(j)][GAIN], self.valve[int(j)][GAIN + 1])
                most = ca.fmax(most, ca.fmin(gain * r, 1.0))
            asked.append(most)
            power += self.pump[m][FLOW] * most * ca.fmax(p[m], 0.0)
        limit = ca.fmin(1.0, self.circuit[POWER] / ca.fmax(power, IDLE))
        goals, keep = [limit * most for most in asked], [math.exp(-step / pump[LAG]) for pump in self.pump]
        after = [goals[m] + (d[m] - goals[m]) * keep[m] for m in range(self.pumps)]
        return ca.Function("displaced", [d, rows, p], [ca.vertcat(*after) if after else ca.SX(0, 1)])

    def _load_function(self) -> ca.Function:
        """Inertia, and forces of gravity and of turning: equations of Lagrange of inertia and potential by strokes."""
        s, v = ca.SX.sym("s", self.n), ca.SX.sym("v", self.n)
        mass, potential = self._bodies(s) if self.linked else self._polynomials(s)
        rate = ca.reshape(ca.jtimes(ca.vec(mass), s, v), self.n, self.n)
        turning = rate @ v - ca.gradient(0.5 * ca.mtimes([v.T, mass, v]), s)
        return ca.Function("load", [s, v], [mass, ca.gradient(potential, s) + turning])

    def _polynomials(self, s: Any) -> tuple[Any, Any]:
        """Inertia L L' and potential as polynomials of the strokes."""
        z, powers = (s - self.w["middle"]) * self.w["scale"], self.at["exponents"]
        terms = ca.vertcat(
            *(math.prod((z[i] ** int(e) for i, e in enumerate(row)), start=ca.SX(1.0)) for row in powers)
        )
        first, count, potential_at = self.load_at
        low = ca.SX.zeros(self.n, self.n)
        for a in range(self.n):
            for c in range(a + 1):
                low[a, c] = ca.dot(self.q[first : first + count], terms[:count])
                first += count
        return low @ low.T, ca.dot(self.q[potential_at : potential_at + len(powers) - 1], terms[1:])

    def _bodies(self, s: Any) -> tuple[Any, Any]:
        """Inertia and potential of planar bodies, each turned by one cylinder against the last."""
        linkage, size = self.w["linkage"], 1 + KNOT_VALUES * KNOTS
        gravity, lengths, body = linkage[0], linkage[1:3], self.q[self.load_at[0] :][: 4 * BODIES].reshape(BODIES, 4)
        mass = body[:, MASS]
        angle, theta = ca.SX(0.0), []
        for a in range(BODIES):
            joint = linkage[BODIES + a * size :][:size]
            angle = angle + joint_angle(s[int(joint[0])], joint[1:].reshape(KNOTS, KNOT_VALUES))
            theta.append(angle)
        angles, coupled, potential = ca.vertcat(*theta), ca.SX.zeros(BODIES, BODIES), ca.SX(0.0)
        for b in range(BODIES):
            behind = mass[b + 1 :].sum()
            length = lengths[b] if b + 1 < BODIES else 0.0
            x, y = mass[b] * body[b, CENTRE_X] + length * behind, mass[b] * body[b, CENTRE_Y]
            own = mass[b] * (body[b, CENTRE_X] ** 2 + body[b, CENTRE_Y] ** 2)
            coupled[b, b] = body[b, INERTIA] + own + length**2 * behind
            potential += gravity * (x * ca.sin(theta[b]) + y * ca.cos(theta[b]))
            for a in range(b):
                apart = theta[b] - theta[a]
                coupled[a, b] = coupled[b, a] = lengths[a] * (x * ca.cos(apart) - y * ca.sin(apart))
        turn = ca.jacobian(angles, s)
        return turn.T @ coupled @ turn, potential

    def contents(self, y: Any) -> Any:
        """Oil of all nodes, see `edp.networks.twin.grey.stage.content`, and the velocities themselves."""
        p = y[: self.nodes]
        return ca.vertcat(p - self.air / (p + ATMOSPHERE), y[self.nodes :])

    def pressures(self, content: Any) -> Any:
        """Return the pressures at which the nodes hold the given oil, and the velocities: the inverse of `contents`.

        Above a vacuum, whatever is content; a stage is solved for what is content, since it is nearly linear in that.
        """
        least = content[: self.nodes] + ATMOSPHERE
        root = ca.sqrt(least * least + 4.0 * self.air)
        # Each half is free of cancellation on its side.
        absolute = ca.if_else(least > 0.0, 0.5 * (root + least), 2.0 * self.air / (root - ca.fmin(least, 0.0)))
        return ca.vertcat(absolute - ATMOSPHERE, content[self.nodes :])

    def _stage(self, step: float) -> tuple[ca.Function, ca.Function]:
        """Return the solver of a stage ``(guess, parameters) -> contents``, and a function for the largest residual."""
        n, sizes = self.n, (self.unknown, self.n, self.valves, self.pumps, self.n, self.n * self.n, self.n, self.n, 1)
        content, fixed = ca.SX.sym("content", self.unknown), ca.SX.sym("fixed", sum(sizes))
        base, bristle, x, d, s, mass, force, reached, half = ca.vertsplit(fixed, [0, *np.cumsum(sizes).tolist()])
        y = self.pressures(content)
        p, v = [y[k] for k in range(self.nodes)], content[self.nodes :]
        net = self._flows([*p, self.circuit[TANK], self.circuit[SUPPLY]], x, d, s)
        rows = []
        for k in range(self.nodes):
            volume: Any
            if k < 2 * n:
                i, side = k % n, k // n
                way, area = (1.0, -1.0)[side], self.actuator[i][HEAD_AREA + side]
                room = ca.fmax(way * (s[i] - self.actuator[i][(STOP_LOW, STOP_HIGH)[side]]), 0.0)
                volume, into = self.actuator[i][HEAD_DEAD + side] + area * room, net[k] - way * area * v[i]
            else:
                volume, into = self.pump[k - 2 * n][LINE], net[k]
            rows.append(content[k] - base[k] - step * self.circuit[BULK] / volume * into)
        inertial = ca.reshape(mass, n, n) @ (v - base[self.nodes :])
        for i in range(n):
            push = self.actuator[i][HEAD_AREA] * p[i] - self.actuator[i][ROD_AREA] * p[n + i] - force[i]
            stroke, low, high = reached[i] + half * v[i], self.actuator[i][STOP_LOW], self.actuator[i][STOP_HIGH]
            depth = ca.fmin(stroke - low, 0.0) + ca.fmax(stroke - high, 0.0)
            rubbing = self._friction(i, v[i], bristle[i], step)[1]
            rows.append(inertial[i] - step * (push - rubbing - self.actuator[i][STOP_STIFFNESS] * depth))
        residual = ca.vertcat(*rows)
        root = ca.rootfinder("stage", "newton", {"x": content, "p": fixed, "g": residual}, ROOT)
        left = ca.Function("left", [content, fixed], [ca.mmax(ca.fabs(residual))])
        slopes = ca.Function("slopes", [content, fixed], [residual, ca.jacobian(residual, content)])
        return patient(root, left, slopes), left

    def _flows(self, p: list[Any], x: Any, d: Any, s: Any) -> list[Any]:
        """Net flow into each node, tank and supply behind the others."""
        net: list[Any] = [ca.SX(0.0)] * len(p)

        def edge(f: int, t: int, area: Any, checked: bool = False) -> None:
            g = turbulent(p[f] - p[t])
            flow = area * (ca.if_else(p[f] < p[t], CHECK * g, g) if checked else g)
            net[f], net[t] = net[f] - flow, net[t] + flow

        n, tank = self.n, len(p) - 2
        for j in range(self.valves):
            for side in range(2):
                self._spool(j, side, x[j], s, edge, tank)
        for i in range(n):
            leak = self.actuator[i][PISTON_LEAK] * (p[i] - p[n + i])
            net[i], net[n + i] = net[i] - leak, net[n + i] + leak
            for side in range(2):
                k = i + side * n
                lost = self.actuator[i][SPOOL_LEAK] * (p[k] - p[tank])
                lost += self.circuit[PORT_SLOPE] * ca.fmax(p[k] - self.actuator[i][HEAD_RELIEF + side], 0.0)
                net[k] += self.circuit[MAKE_UP] * turbulent(ca.fmax(p[tank] - p[k], 0.0)) - lost
        for m in range(self.pumps):
            k, area = 2 * n + m, ca.SX(self.pump[m][BYPASS])
            for spool in np.flatnonzero(self.at["valve_pump"] == m):
                area *= ca.fmax(1.0 - ca.fabs(x[int(spool)]) / self.pump[m][BYPASS_CLOSED], 0.0) ** 2
            edge(k, tank, area)
            over = ca.fmax(p[k] - self.pump[m][RELIEF], 0.0)
            net[k] += self.pump[m][FLOW] * d[m] - self.circuit[RELIEF_SLOPE] * over
        return net

    def _spool(self, j: int, side: int, x: Any, s: Any, edge: Any, tank: int) -> None:
        """Add the edges of one spool in one direction; they are closed while the spool moves the other way."""
        i, pump = int(self.at["valve_actuator"][j]), int(self.at["valve_pump"][j])
        band, at = self.valve[j][BAND + side], self.at["valve_at"][j]
        r = ca.fmin(ca.fmax(((1.0, -1.0)[side] * x - band) / (1.0 - band), 0.0), 1.0)
        fed, other = (i, self.n + i) if side == 0 else (self.n + i, i)
        edge(2 * self.n + pump if pump != NONE else tank + 1, fed, self._opening(r, int(at[INTO + side])), True)
        if at[OUT_OF + side] == NONE:
            return
        low, high = self.actuator[i][STOP_LOW], self.actuator[i][STOP_HIGH]
        left = (high - s[i] if side == 0 else s[i] - low) / self.actuator[i][CUSHION_LENGTH]
        near, least = ca.fmin(ca.fmax(left, 0.0), 1.0), self.actuator[i][CUSHION_LEAST]
        area = self._opening(r, int(at[OUT_OF + side])) * (least + (1.0 - least) * near * near * (3.0 - 2.0 * near))
        edge(other, tank, area)
        if at[REGENERATION + side] != NONE:
            edge(other, fed, area * self.valve[j][REGENERATION + side], True)

    def _opening(self, r: Any, first: int) -> Any:
        """Area of a monotone curve at r in [0, 1]."""
        knots, area = self.w["knots"], ca.SX(0.0)
        for k in range(len(knots) - 1):
            share = ca.fmin(ca.fmax((r - knots[k]) / (knots[k + 1] - knots[k]), 0.0), 1.0)
            area += float(self.q[first + k]) * share
        return area

    def _friction(self, i: int, v: Any, before: Any, step: float) -> tuple[Any, Any]:
        """Deflection of the bristle of LuGre friction after an implicit step, and the force."""
        ratio = v / self.actuator[i][STRIBECK]
        fade = ca.exp(-ratio * ratio)
        level = self.actuator[i][COULOMB] + self.actuator[i][STATIC] * fade
        stiffness, damping = self.actuator[i][BRISTLE], self.actuator[i][BRISTLE_DAMPING] * fade / step
        z = (before + step * v) / (1.0 + stiffness * step * ca.fabs(v) / level)
        force = (stiffness + damping) * z - damping * before + self.actuator[i][VISCOUS] * v
        return z, force + self.actuator[i][ASYMMETRY] * ca.tanh(ratio) ** 2

    def _bristle_function(self, step: float) -> ca.Function:
        v, before = ca.SX.sym("v", self.n), ca.SX.sym("before", self.n)
        after = [self._friction(i, v[i], before[i], step)[0] for i in range(self.n)]
        return ca.Function("bristles", [v, before], [ca.vertcat(*after)])

    def feed(self, fed: Any, y: Any, s: Any) -> tuple[Any, Any]:
        """Replace pressures, velocities and strokes by the values at the ports."""
        values = self.w["offset"] + self.w["answer_width"] * fed
        of_y, of_s = ca.vertsplit(y), ca.vertsplit(s)
        for c, (kind, which) in enumerate(self.at["ports"]):
            if kind == 1:
                of_s[which] = values[c]
            elif kind == 0:
                of_y[self.nodes + which] = values[c]
            else:
                of_y[which] = ca.fmax(values[c], LEAST_ABSOLUTE - ATMOSPHERE)
        return ca.vertcat(*of_y), ca.vertcat(*of_s)

    def step(self, y: Any, s: Any, z: Any, d: Any, rows: Any, history: Any) -> tuple[Any, ...]:
        """One implicit step: two stages of an L-stable SDIRK method of order two (Alexander 1977)."""
        length, before = self.tick_s / self.steps, y[self.nodes :]
        frozen = s + 0.5 * length * self.moved * before
        mass, force = self.load(frozen, before)
        content = base = self.contents(y)
        base_z = z
        for which in range(2):
            rows = self.advance[which](rows, history)
            if which == 0 and self.pumps:
                d = self.displaced(d, rows, y[2 * self.n : self.nodes])
            half = 0.5 * (GAMMA * length if which == 0 else length)
            spools = rows[SPOOL, :].T
            fixed = ca.vertcat(base, base_z, spools, d, frozen, ca.vec(mass), force, s + half * before, half)
            solution = self.root(content, fixed)
            content = ca.if_else(self.left(solution, fixed) < LEFT, solution, math.nan)
            after = self.bristles(content[self.nodes :], base_z)
            if which == 0:
                base = base + AHEAD * (content - base)
                base_z = z + AHEAD * (after - z)
        y = self.pressures(content)
        return y, s + 0.5 * length * self.moved * (before + y[self.nodes :]), after, d, rows

    def tick(self, m: dict[str, Any], commands: Any, fed: Any) -> Any:
        """Advance one sample and return the scaled outputs without strokes; `m` is the state, updated in place."""
        history = ca.horzcat(self.demands(commands), m["history"][:, :-1])
        y, s = self.feed(fed, m["pressures_and_velocities"], m["strokes"])
        start = s, y[self.nodes :]
        z, rows = m["bristles"], m["valves"]
        d = m["displacements"] if self.pumps else ca.MX(0, 1)
        for _ in range(self.steps):
            y, s, z, d, rows = self.step(y, s, z, d, rows, history)
        # What a twin promises: a stroke is the trapezoidal integral of the velocities that it answers, one a tick.
        s = start[0] + 0.5 * self.tick_s * self.moved * (start[1] + y[self.nodes :])
        m["pressures_and_velocities"], m["strokes"], m["bristles"], m["valves"], m["history"] = y, s, z, rows, history
        m["displacements"] = d if self.pumps else m["displacements"]
        answers = []
        for c, (kind, which) in enumerate(self.at["ports"]):
            if kind != 1:
                value = y[int(which) + (self.nodes if kind == 0 else 0)]
                answers.append((value - float(self.w["offset"][c])) / float(self.w["answer_width"][c]))
        return ca.vertcat(*answers)


def patient(root: ca.Function, left: ca.Function, slopes: ca.Function) -> ca.Function:
    """Return a root finder that repeats the search with damped steps if the first search fails.

    Where a check or a relief toggles no step makes every residual less; steps that go to and fro are halved instead.
    `left` is the largest residual at a root, `slopes` gives residuals and their Jacobian.
    """
    guess, fixed = (ca.MX.sym(name, root.size1_in(k)) for k, name in enumerate(("guess", "fixed")))
    content, before, share = ca.MX.sym("content", guess.numel()), ca.MX.sym("before", guess.numel()), ca.MX.sym("share")
    residual, jacobian = slopes(content, fixed)
    step = -ca.solve(jacobian, residual)
    back = ca.logic_and(ca.dot(step, before) < 0.0, ca.norm_2(step) > 0.5 * ca.norm_2(before))
    shared = ca.if_else(back, ca.fmax(0.5 * share, LEAST_SHARE), ca.fmin(2.0 * share, 1.0))
    one = ca.Function("one", [content, before, share, fixed], [content + shared * step, step, shared])
    state = guess, ca.MX.zeros(guess.numel()), ca.MX(1.0)
    whole = one.mapaccum("whole", DAMPED, 3, {"base": DAMPED})(*state, fixed)
    names = [ca.MX.sym("solution", guess.numel()), guess, fixed]
    keep = ca.Function("keep", names, [names[0]])
    again = ca.Function("again", names, [whole[0][:, -1]])
    solution = root(guess, fixed)
    # One branch is computed, as a rule the short one; derivatives are those of the last root, whatever it began with.
    chosen = ca.Function.if_else("chosen", keep, again)(left(solution, fixed) < LEFT, solution, guess, fixed)
    return ca.Function("patient", [guess, fixed], [root(chosen, fixed)])


def joint_angle(stroke: Any, knots: np.ndarray) -> Any:
    """Angle of a joint at a stroke: quintic polynomials between knots (stroke, angle, slope, curvature), then lines."""
    at, angle, slope, bend = knots.T
    width, rise = np.diff(at), np.diff(angle)
    d_0, d_1, b_0, b_1 = slope[:-1] * width, slope[1:] * width, bend[:-1] * width**2, bend[1:] * width**2
    powers = np.stack([
        angle[:-1], d_0, 0.5 * b_0,
        10.0 * rise - 6.0 * d_0 - 4.0 * d_1 - 1.5 * b_0 + 0.5 * b_1,
        -15.0 * rise + 8.0 * d_0 + 7.0 * d_1 + 1.5 * b_0 - b_1,
        6.0 * rise - 3.0 * (d_0 + d_1) - 0.5 * (b_0 - b_1),
    ])  # fmt: skip
    past = [ca.SX(1.0), *(stroke >= inner for inner in at[1:-1]), ca.SX(0.0)]
    here = ca.vertcat(*(past[k] - past[k + 1] for k in range(len(width))))
    along = (stroke - ca.dot(here, at[:-1])) / ca.dot(here, width)
    u = ca.fmin(ca.fmax(along, -BEYOND), 1.0 + BEYOND)
    c = ca.DM(powers) @ here
    value, first = c[5], ca.SX(0.0)
    for power in (c[4], c[3], c[2], c[1], c[0]):
        first = first * u + value
        value = value * u + power
    return value + (along - u) * first


def write_tick(part: Any, commands: Any, fed: Any) -> Any:
    """Build the layer for `edp_casadi.LAYERS`."""
    return HydraulicMachine(part.options, part.w).tick(part.m, commands, fed)
