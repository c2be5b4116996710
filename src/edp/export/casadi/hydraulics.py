"""One sample of a grey box for CasADi: pumps, valves, cylinders, motors and their load. Needs NumPy and CasADi.

Newton's method of CasADi solves each implicit stage; derivatives of any order follow from the implicit function
theorem. A stage without convergence gives NaN. Units are m, s, MPa, MN and Gg.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.equations import GAMMA, MISSING, Equations, GreyForm, Stage

STAGE_RATIO = (1.0 - GAMMA) / GAMMA
EXTRAPOLATION = 1.0
"""Maximum extrapolation of a joint angle, in widths of the last knot interval."""
NEWTON = {"abstolStep": 1e-9, "max_iter": 60, "error_on_fail": False}
"""Settings of Newton's method. The tolerance (MPa, m/s) is far below the rounding errors of single precision."""
MAX_RESIDUAL = 1e-6
"""Maximum residual of a solution, MPa and Gg m/s."""
DAMPED_STEPS, MIN_DAMPING = 40, 0.125
"""Number of damped Newton steps, and the smallest damping factor."""


class CasadiAlgebra:
    """Algebra of `Equations` on CasADi symbols and on floats."""

    def __init__(self) -> None:
        self.sqrt, self.exp, self.tanh, self.sin, self.cos = ca.sqrt, ca.exp, ca.tanh, ca.sin, ca.cos

    def less(self, a: Any, b: Any, then: Any, otherwise: Any) -> Any:
        """Return `then` where a < b, else `otherwise`."""
        if isinstance(a, float | int) and isinstance(b, float | int):
            return then if a < b else otherwise
        return ca.if_else(a < b, then, otherwise)

    def derivatives(self, results: Any, variables: Any) -> list[list[Any]]:
        """Return the Jacobian as nested lists, one row per result."""
        slopes = ca.jacobian(ca.vertcat(*results), ca.vertcat(*variables))
        return [[slopes[row, column] for column in range(len(variables))] for row in range(len(results))]


class HydraulicMachine:
    """Grey box of one machine as CasADi functions.

    Args:
        layer: options of the layer, from the exported description.
        w: arrays of the layer by name.
    """

    def __init__(self, layer: dict[str, Any], w: Mapping[str, np.ndarray]) -> None:
        self.w = {name: np.asarray(values, dtype=float) for name, values in w.items()}
        places = ("valve_at", "valve_actuator", "valve_pump", "actuator_at", "pump_at", "ports", "exponents", "sides")
        self.at = {name: np.asarray(w[name]).astype(int) for name in places}
        self.tick_s, self.steps, self.remembered = layer["tick_s"], layer["steps"], layer["remembered"]
        linkage = self.w["linkage"] if len(self.w["linkage"]) > 1 else np.zeros(at.JOINTS)
        self.joints = linkage[at.JOINTS :].reshape(-1, at.JOINT_VALUES)
        form = GreyForm.from_arrays(self.w, self.w["linkage"], layer["circuit"], layer["load"])
        self.n, self.valves, self.pumps = form.actuators, form.valves, form.pumps
        self.nodes, self.unknown = form.nodes, form.unknowns
        constants = [*self.w["middle"].tolist(), *self.w["scale"].tolist(), *linkage[: at.JOINTS].tolist()]
        self.equations = Equations(form, self.w["numbers"].tolist(), constants, CasadiAlgebra())
        circuit = self.equations.circuit
        self.air = max(circuit[at.BULK] * circuit[at.AIR] * at.ATMOSPHERE, 1e-9)
        step = self.tick_s / self.steps
        self.moved = np.where(self.w["scale"] > 0.0, 1.0, 0.0)
        self.load = self._load_function()
        self.advance = [self._advance_function(length) for length in (GAMMA * step, step - GAMMA * step)]
        self.displaced = self._make_displacement_function(step)
        self.root, self.residual = self._stage(GAMMA * step)
        self.bristles = self._bristle_function(GAMMA * step)

    def demands(self, commands: Any) -> Any:
        """Return the signed commands of the valves as fractions of full scale, extension positive."""
        parts = []
        for j, (extend, retract) in enumerate(self.at["sides"]):
            signed = commands[int(extend)] - (commands[int(retract)] if retract != MISSING else 0.0)
            share = signed / float(self.w["full"][j])
            # fmin and fmax would replace NaN by a limit.
            parts.append(ca.if_else(ca.fabs(share) < math.inf, ca.fmin(ca.fmax(share, -1.0), 1.0), math.nan))
        return ca.vertcat(*parts)

    def _advance_function(self, step: float) -> ca.Function:
        """Return the function that advances dead time, pilot lags, play and spool lags; one column per valve."""
        rows, history = ca.SX.sym("rows", at.VALVE_STATES, self.valves), ca.SX.sym("h", self.valves, self.remembered)
        columns = []
        for j, places in enumerate(self.equations.form.valve_at):
            ticks = self.equations.q[places[at.DELAY]] / self.tick_s
            ticks = min(max(ticks, 0.0), history.shape[1] - 2.0)
            whole = min(int(ticks), history.shape[1] - 2)
            command = history[j, whole] + (ticks - whole) * (history[j, whole + 1] - history[j, whole])
            state, factors = ca.vertsplit(rows[:, j]), self.equations.lag_factors(j, step)
            columns.append(ca.vertcat(*self.equations.advance_valve(state, command, factors)))
        return ca.Function("advance", [rows, history], [ca.horzcat(*columns)])

    def _make_displacement_function(self, step: float) -> ca.Function:
        """Return the function for the pump displacements: pilot demands under the common power limit."""
        rows = ca.SX.sym("rows", at.VALVE_STATES, self.valves)
        d, p = ca.SX.sym("d", self.pumps), ca.SX.sym("p", self.pumps)
        pilots = [rows[at.PILOT_2, j] for j in range(self.valves)]
        after = self.equations.displacements(ca.vertsplit(d), pilots, ca.vertsplit(p), step) if self.pumps else []
        return ca.Function("displaced", [d, rows, p], [ca.vertcat(*after) if after else ca.SX(0, 1)])

    def _load_function(self) -> ca.Function:
        """Return the function for the inertia matrix and the gravity and velocity-product forces."""
        s, v = ca.SX.sym("s", self.n), ca.SX.sym("v", self.n)
        strokes = ca.vertsplit(s)
        joints = [
            joint_angle(strokes[int(joint[at.ACTUATOR])], joint[at.KNOT :].reshape(at.LINKAGE_KNOTS, at.KNOT_VALUES))
            for joint in self.joints
        ]
        mass, forces = self.equations.load(strokes, ca.vertsplit(v), joints)
        rows = [ca.horzcat(*row) for row in mass]
        return ca.Function("load", [s, v], [ca.vertcat(*rows), ca.vertcat(*forces)])

    def contents(self, y: Any) -> Any:
        """Return the oil contents of all nodes, see `Equations.contents`, followed by the velocities."""
        p = y[: self.nodes]
        return ca.vertcat(p - self.air / (p + at.ATMOSPHERE), y[self.nodes :])

    def pressures(self, content: Any) -> Any:
        """Return pressures and velocities from oil contents and velocities: the inverse of `contents`.

        Every content gives a pressure above vacuum. The unknowns of a stage are contents, because its residual is
        nearly linear in them.
        """
        least = content[: self.nodes] + at.ATMOSPHERE
        root = ca.sqrt(least * least + 4.0 * self.air)
        # Each formula avoids cancellation on its side of zero.
        absolute = ca.if_else(least > 0.0, 0.5 * (root + least), 2.0 * self.air / (root - ca.fmin(least, 0.0)))
        return ca.vertcat(absolute - at.ATMOSPHERE, content[self.nodes :])

    def _stage(self, step: float) -> tuple[ca.Function, ca.Function]:
        """Return the solver of a stage ``(guess, parameters) -> contents``, and a function for the largest residual."""
        n, sizes = self.n, (self.unknown, self.n, self.valves, self.pumps, self.n, self.n * self.n, self.n, self.n, 1)
        content, fixed = ca.SX.sym("content", self.unknown), ca.SX.sym("fixed", sum(sizes))
        parts = ca.vertsplit(fixed, [0, *np.cumsum(sizes).tolist()])
        base, bristles, spools, displacements, strokes, mass, forces, reached, (half,) = map(ca.vertsplit, parts)
        stage = Stage(base, bristles, spools, displacements, strokes, reached, half, step)
        inertia = [[mass[i + n * k] for k in range(n)] for i in range(n)]
        y, filled = ca.vertsplit(self.pressures(content)), ca.vertsplit(content[: self.nodes])
        residual = ca.vertcat(*self.equations.stage(y, stage, inertia, forces, filled))
        root = ca.rootfinder("stage", "newton", {"x": content, "p": fixed, "g": residual}, NEWTON)
        residual_of = ca.Function("residual", [content, fixed], [ca.mmax(ca.fabs(residual))])
        slopes = ca.Function("slopes", [content, fixed], [residual, ca.jacobian(residual, content)])
        return damped_root_finder(root, residual_of, slopes), residual_of

    def _bristle_function(self, step: float) -> ca.Function:
        v, before = ca.SX.sym("v", self.n), ca.SX.sym("before", self.n)
        after = [self.equations.friction(i, v[i], before[i], step)[0] for i in range(self.n)]
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
                of_y[which] = ca.fmax(values[c], at.LEAST_ABSOLUTE - at.ATMOSPHERE)
        return ca.vertcat(*of_y), ca.vertcat(*of_s)

    def step(self, y: Any, s: Any, z: Any, d: Any, rows: Any, history: Any) -> tuple[Any, ...]:
        """Advance one implicit step: two stages of an L-stable SDIRK method of order two (Alexander 1977)."""
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
            spools = rows[at.SPOOL, :].T
            fixed = ca.vertcat(base, base_z, spools, d, frozen, ca.vec(mass), force, s + half * before, half)
            solution = self.root(content, fixed)
            content = ca.if_else(self.residual(solution, fixed) < MAX_RESIDUAL, solution, math.nan)
            after = self.bristles(content[self.nodes :], base_z)
            if which == 0:
                base = base + STAGE_RATIO * (content - base)
                base_z = z + STAGE_RATIO * (after - z)
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
        # The stroke of every twin is the trapezoidal integral of its velocity outputs, one step per sample.
        s = start[0] + 0.5 * self.tick_s * self.moved * (start[1] + y[self.nodes :])
        m["pressures_and_velocities"], m["strokes"], m["bristles"], m["valves"], m["history"] = y, s, z, rows, history
        m["displacements"] = d if self.pumps else m["displacements"]
        answers = []
        for c, (kind, which) in enumerate(self.at["ports"]):
            if kind != 1:
                value = y[int(which) + (self.nodes if kind == 0 else 0)]
                answers.append((value - float(self.w["offset"][c])) / float(self.w["answer_width"][c]))
        return ca.vertcat(*answers)


def damped_root_finder(root: ca.Function, residual_of: ca.Function, slopes: ca.Function) -> ca.Function:
    """Return a root finder that continues with damped Newton steps if `root` fails.

    Newton's method can alternate between two points if a check valve or a relief valve toggles. The damping factor is
    halved after each step that reverses the last one, and doubled otherwise.

    Args:
        root: Newton solver ``(guess, parameters) -> contents``.
        residual_of: largest residual, from contents and parameters.
        slopes: residuals and their Jacobian, from contents and parameters.
    """
    guess, fixed = (ca.MX.sym(name, root.size1_in(k)) for k, name in enumerate(("guess", "fixed")))
    content, before, share = ca.MX.sym("content", guess.numel()), ca.MX.sym("before", guess.numel()), ca.MX.sym("share")
    residual, jacobian = slopes(content, fixed)
    step = -ca.solve(jacobian, residual)
    back = ca.logic_and(ca.dot(step, before) < 0.0, ca.norm_2(step) > 0.5 * ca.norm_2(before))
    shared = ca.if_else(back, ca.fmax(0.5 * share, MIN_DAMPING), ca.fmin(2.0 * share, 1.0))
    one = ca.Function("one", [content, before, share, fixed], [content + shared * step, step, shared])
    state = guess, ca.MX.zeros(guess.numel()), ca.MX(1.0)
    whole = one.mapaccum("whole", DAMPED_STEPS, 3, {"base": DAMPED_STEPS})(*state, fixed)
    names = [ca.MX.sym("solution", guess.numel()), guess, fixed]
    keep = ca.Function("keep", names, [names[0]])
    again = ca.Function("again", names, [whole[0][:, -1]])
    solution = root(guess, fixed)
    # CasADi evaluates one branch only. The final call of `root` gives the derivatives, independent of its guess.
    chosen = ca.Function.if_else("chosen", keep, again)(
        residual_of(solution, fixed) < MAX_RESIDUAL, solution, guess, fixed
    )
    return ca.Function("damped_root", [guess, fixed], [root(chosen, fixed)])


def joint_angle(stroke: Any, knots: np.ndarray) -> Any:
    """Return the angle of a joint at a stroke.

    Args:
        stroke: m; beyond the first and last knot the angle continues as a polynomial, then as a line.
        knots: stroke, angle, slope and curvature at the knots of quintic polynomials, shape (knot, 4).
    """
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
    u = ca.fmin(ca.fmax(along, -EXTRAPOLATION), 1.0 + EXTRAPOLATION)
    c = ca.DM(powers) @ here
    value, first = c[5], ca.SX(0.0)
    for power in (c[4], c[3], c[2], c[1], c[0]):
        first = first * u + value
        value = value * u + power
    return value + (along - u) * first


def write_tick(part: Any, commands: Any, fed: Any) -> Any:
    """Build the layer for `edp_casadi.LAYERS`."""
    return HydraulicMachine(part.options, part.w).tick(part.m, commands, fed)
