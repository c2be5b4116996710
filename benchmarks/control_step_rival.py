"""CasADi's `sqpmethod` on the problem of the predictive controller: the rival of `control_step.py`."""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from edp.export import make_target
from edp.export.controller import ControllerParts, PlanParts
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.control.kept import KeptController


class Rival:
    """The same problem for CasADi's `sqpmethod`.

    Args:
        kept: the controller.
        parts: its numbers.
        folder: for the exported twin.
    """

    def __init__(self, kept: KeptController, parts: ControllerParts, folder: Path) -> None:
        import casadi as ca

        self.twin = twin_of(kept)
        make_target("casadi").write(plant_bundle(self.twin), "plant", folder)
        sys.path.insert(0, str(folder))
        self.network = importlib.import_module("edp_casadi").Network(str(folder / "plant.json"))
        self.ca, self.parts, self.plan = ca, parts, plan_of(parts)
        self._solve = self._solver()

    def _solver(self) -> Any:
        ca, plan = self.ca, self.plan
        blocks, count, ticks = plan.blocks, plan.variables, sum(plan.blocks)
        sizes = {"x": len(self.network.start), "first": len(self.network.inputs) - len(plan.pilots), "before": 3,
                 "latest": 3, "off": 3, "turn": 9 * ticks, "tip": 3 * ticks, "ahead": count}  # fmt: skip
        symbols = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
        c, x, lever = ca.MX.sym("c", count), symbols["x"], symbols["before"]
        residuals, tick = [], 0
        for block, length in enumerate(blocks):
            target = self._levers(c[3 * block : 3 * block + 3])
            for _ in range(length):
                step = ca.DM(self.parts.slew)
                lever = lever + ca.fmin(ca.fmax(target - lever, -step), step)
                ports = symbols["first"] if tick == 0 else ca.DM.zeros(sizes["first"])
                x, answer = self.network.step(x, ca.vertcat(self._pilots(lever), ports))[:2]
                strokes = ca.vertcat(*(answer[i] for i in plan.strokes))
                strokes = strokes + (tick + 1) / self.parts.rate_hz * symbols["off"]
                error = self._tip(strokes) - symbols["tip"][3 * tick : 3 * tick + 3]
                turn = ca.reshape(symbols["turn"][9 * tick : 9 * tick + 9], 3, 3).T
                residuals.append(turn @ error)
                tick += 1
        _, _, change, forward, _, _ = plan.weights
        steps = c - ca.vertcat(symbols["latest"], c[: count - 3])
        residuals += [change**0.5 * steps, forward**0.5 * (c - symbols["ahead"])]
        residual, given = ca.vertcat(*residuals), ca.vertcat(*symbols.values())
        slope, scale, none = ca.jacobian(residual, c), ca.MX.sym("s"), ca.MX.sym("m", 0)
        curve = ca.Function("curve", [c, given, scale, none], [scale * (slope.T @ slope)])
        quiet = dict.fromkeys(("print_time", "print_header", "print_iteration", "print_status"), False)
        options = {"qpsol": "daqp", "qpsol_options": {"print_problem": False, "error_on_fail": False},
                   "hess_lag": curve, "max_iter": 1, "max_iter_ls": 0, "error_on_fail": False}  # fmt: skip
        problem = {"x": c, "p": given, "f": 0.5 * ca.sumsqr(residual)}
        return ca.nlpsol("solve", "sqpmethod", problem, options | quiet)

    def _levers(self, speeds: Any) -> Any:
        levers = []
        for axis, sides in enumerate(self.plan.sides):
            out, back = (
                self.ca.interpolant(f"side_{axis}_{i}", "linear", [list(rising(s))], list(v))
                for i, (s, v) in enumerate(sides)
            )
            speed = speeds[axis]
            inside = [self.ca.fmin(self.ca.fmax(sign * speed, 0.0), float(side[0][-1]))
                      for sign, side in zip((1.0, -1.0), sides)]  # fmt: skip
            levers.append(out(inside[0]) - back(inside[1]))
        return self.ca.vertcat(*levers)

    def _pilots(self, levers: Any) -> Any:
        ca, (full, zone, start) = self.ca, self.plan.lever_shape
        rows = []
        for pilot in self.plan.pilots:
            size = ca.fmin(ca.fmax(((1.0 if pilot.extend else -1.0) * levers[pilot.axis] - zone) / (1.0 - zone), 0), 1)
            second = pilot.share * ca.fmin(ca.fmax((size - start) / (1.0 - start), 0), 1)
            rows.append(full * (second if pilot.second else size))
        return ca.vertcat(*rows)

    def _tip(self, strokes: Any) -> Any:
        ca, parts = self.ca, self.parts
        nodes = [list(np.linspace(0.0, full, len(parts.angles))) for full in parts.full_m]
        angle, x, y = 0.0, 0.0, 0.0
        for axis in range(3):
            angles = ca.interpolant(f"joint_{axis}", "linear", [nodes[axis]], list(parts.angles[:, axis]))
            angle = angle + angles(strokes[axis])
            x, y = x + parts.lengths_m[axis] * ca.cos(angle), y + parts.lengths_m[axis] * ca.sin(angle)
        return ca.vertcat(x, y, angle)

    def compare(self, kept: KeptController, ticks: tuple[int, ...]) -> tuple[list[float], float]:
        """Processor ms of an iteration at these ticks of the loop, and how far its step is from ours at most, m/s."""
        from edp.control.controllers.nmpc import NmpcController, _directions
        from edp.control.reference import TipReference

        reference = TipReference(kept.plant.rate_hz, kept.strokes, kept.tip, np.ones(len(kept.strokes), bool))
        controller = kept.experiment.controller.build(kept.plant, kept.experiment.task.limits, kept.models)
        if not isinstance(controller, NmpcController):
            raise TypeError("the controller of this benchmark plans")
        controller.reset(kept.observed[0], reference)
        columns = kept.plant.columns(controller.reads)
        x = self._rest(kept, kept.observed[0, columns])
        spent, apart = [], 0.0
        for tick in range(max(ticks) + 1):
            measured = kept.observed[tick, columns]
            before, memory = controller.before.copy(), controller.memory.copy()
            levers = controller.step(kept.observed[tick], tick)
            ports = self._ports(measured)
            if tick in ticks:
                rows = reference.rows(tick + 1, sum(self.plan.blocks))
                latest, off = memory[self.plan.variables :][:3], controller.model.disturbance
                ahead = controller._ahead[min(tick, len(controller._ahead) - 1)]
                given = np.concatenate([x, ports, before, latest, off,
                                        _directions(reference, controller.spec)[rows].ravel(),
                                        reference.tip[rows].ravel(), ahead])  # fmt: skip
                now, trust = memory[: self.plan.variables], self.plan.weights[4]
                low = np.maximum(np.tile(self.plan.slowest, len(self.plan.blocks)), now - trust)
                high = np.minimum(np.tile(self.plan.fastest, len(self.plan.blocks)), now + trust)
                began = time.process_time()
                solution = self._solve(x0=now, p=given, lbx=low, ubx=high)
                spent.append(1000.0 * (time.process_time() - began))
                plan = controller.memory[: self.plan.variables]
                apart = max(apart, float(np.abs(np.array(solution["x"]).ravel() - plan).max()))
            row = np.concatenate([self._commands(kept, levers), ports])
            x = np.array(self.network.step(x, row)[0]).ravel()
        return spent, apart

    def _commands(self, kept: KeptController, levers: np.ndarray) -> np.ndarray:
        names = [channel.name for channel in kept.plant.command_channels]
        return kept.plant.commands(levers)[[names.index(c.name) for c in self.twin.twin.channels.commands]]

    def _ports(self, measured: np.ndarray) -> np.ndarray:
        """Measured values and flags of the twin."""
        answers = len(self.twin.twin.channels.answers)
        values, flags = np.zeros(answers), np.zeros(answers)
        values[list(self.plan.ports)], flags[list(self.plan.ports)] = measured, 1.0
        return np.concatenate([values, flags])

    def _rest(self, kept: KeptController, measured: np.ndarray) -> np.ndarray:
        twin = self.twin.twin
        values = np.array(twin.scales.answer_offset, float)
        values[list(self.plan.ports)] = measured
        row = np.concatenate([self._commands(kept, np.zeros(3)), values, np.ones(len(values))])
        x = self.network.start
        for _ in range(max(1, twin.prefix_ticks)):
            x = np.array(self.network.step(x, row)[0]).ravel()
        return x


def plan_of(parts: ControllerParts) -> PlanParts:
    if parts.plan is None:
        raise ValueError("the controller of this benchmark plans")
    return parts.plan


def twin_of(kept: KeptController) -> TwinBundle:
    if kept.twin is None:
        raise ValueError("the controller of this benchmark has a twin")
    return kept.twin


def rising(values: Any) -> np.ndarray:
    """Nodes that rise strictly, as interpolants want them."""
    nodes = np.array(values, float)
    for i in range(1, len(nodes)):
        nodes[i] = max(nodes[i], nodes[i - 1] + 1e-9)
    return nodes
