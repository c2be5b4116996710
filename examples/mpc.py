"""Tracks velocities with a network as the plant: ``python examples/mpc.py EXPORTED/plant.json [TICKS]``.

EXPORTED is what ``edp export RUN --format casadi --name plant`` wrote of a run with ``examples/mpc.toml``. Three
commands, one a cylinder: above zero the first pilot pressure of its pair, below it the second. Twenty ticks ahead,
three ways: one Gauss-Newton step a tick on the C code, at most ten of them, and CasADi's SQP on the symbolic step.
"""

import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np

STEPS = 20
FULL = 2.2e6  # Pa, pilot pressure of a full command
WIDTH = 0.05  # m/s, an error that counts as one
MOST = 10  # iterations where it is solved at each tick
REACH = 0.2  # the largest change of a command in one Gauss-Newton step: valves have dead bands
SMOOTH = 0.02  # weight of a change of command from tick to tick
VELOCITIES = ["CylVels_1", "CylVels_2", "CylVels_3"]
PILOTS = ["BmUp", "BmDwn", "AmIn", "AmOut", "BktIn", "BktOut"]
DIFFERENCES = np.eye(3 * STEPS) - np.eye(3 * STEPS, k=-3)  # of the commands of a tick and of the one before
SIGNS = [1, -1, 1, -1, 1, -1]  # of the velocity that each pilot pressure drives


def pilots(commands):
    """Pilot pressures of commands ``(3, steps)``; works on numbers and symbols."""
    rows = [(commands[i // 2, :], SIGNS[i]) for i in range(6)]
    return ca.vertcat(*(FULL * ca.fmax(sign * row, 0) for row, sign in rows))


def wanted(tick):
    """Velocities ``(3, STEPS)`` for the ticks after this one, m/s."""
    when = (tick + 1 + np.arange(STEPS)) / 100.0
    return np.stack([0.08 * np.sin(2 * np.pi * when / period) for period in (2.0, 1.6, 1.2)])


class Symbolic:
    """CasADi's SQP method with DAQP and the Gauss-Newton Hessian."""

    name = f"CasADi sqpmethod + DAQP on the symbolic step, at most {MOST} iterations"

    def __init__(self, network, carry, feed):
        c, state, now = ca.MX.sym("c", 3 * STEPS), ca.MX.sym("x", len(network.start)), ca.MX.sym("v", 6)
        want = ca.MX.sym("w", 3 * STEPS)
        inputs = ca.vertcat(ca.MX(3, STEPS), pilots(ca.reshape(c, 3, STEPS)))
        y = network.horizon(STEPS, carry, feed)(state, ca.vertcat(now[:3], inputs[3:, 0]), inputs)
        change = ca.DM(DIFFERENCES) @ c - ca.vertcat(now[3:], ca.DM(3 * STEPS - 3, 1))
        residual = ca.vertcat((ca.vec(y) - want) / WIDTH, SMOOTH**0.5 * change)
        problem = {"x": c, "p": ca.vertcat(state, now, want), "f": 0.5 * ca.sumsqr(residual)}
        slope, scale, none = ca.jacobian(residual, c), ca.MX.sym("s"), ca.MX.sym("m", 0)
        curve = ca.Function("curve", [c, problem["p"], scale, none], [scale * (slope.T @ slope)])
        quiet = dict.fromkeys(("print_time", "print_header", "print_iteration", "print_status"), False)
        options = {
            "qpsol": "daqp",
            "qpsol_options": {"print_problem": False},
            "hess_lag": curve,
            "tol_du": 1e-3,
            "max_iter": 10,
        }
        self._solve = ca.nlpsol("solve", "sqpmethod", problem, options | quiet | {"tol_du": 1e-3, "max_iter": MOST})

    def __call__(self, state, velocities, in_force, guess, want):
        given = np.concatenate([state, velocities, in_force, want.T.ravel()])
        return np.array(self._solve(x0=guess, p=given, lbx=-1, ubx=1)["x"]).ravel()


class GaussNewton:
    """Horizon and Jacobian from the C code, a QP of 60 commands by DAQP; at most `most` times."""

    def __init__(self, network, carry, feed, most):
        self.name = "C horizon + DAQP, " + (
            "one step a tick (real-time iteration)" if most == 1 else f"at most {most} steps"
        )
        self._horizon = Horizon(network, network.compile(), STEPS, 3, carry, feed)
        self._most = most
        shape = {"h": ca.Sparsity.dense(3 * STEPS, 3 * STEPS), "a": ca.Sparsity(0, 3 * STEPS)}
        self._qp = ca.conic("qp", "daqp", shape, {"print_problem": False})
        self._smooth = SMOOTH**0.5 * DIFFERENCES

    def __call__(self, state, velocities, in_force, guess, want):
        c = guess.copy()
        for _ in range(self._most):
            base, by = np.zeros((STEPS, 9)), np.zeros((STEPS, 3, 9))
            for i, sign in enumerate(SIGNS):
                driven = sign * c[i // 2 :: 3]
                base[:, 3 + i] = FULL * np.maximum(driven, 0)
                by[:, i // 2, 3 + i] = sign * FULL * ((driven > 0) | ((driven == 0) & (sign > 0)))
            first = np.concatenate([velocities, base[0, 3:]])
            y, slope = self._horizon(state, first, base, by)
            slope = np.vstack([slope.reshape(3 * STEPS, 3 * STEPS) / WIDTH, self._smooth])
            change = self._smooth @ c - SMOOTH**0.5 * np.concatenate([in_force, np.zeros(3 * STEPS - 3)])
            residual = np.concatenate([(y - want.T).ravel() / WIDTH, change])
            least, most = np.maximum(-1 - c, -REACH), np.minimum(1 - c, REACH)
            step = np.array(self._qp(h=slope.T @ slope, g=slope.T @ residual, lbx=least, ubx=most)["x"]).ravel()
            c = np.clip(c + step, -1, 1)
            if np.abs(step).max() < 1e-3:
                break
        return c


def track(network, controller, ticks):
    """Closed loop with the network itself as the machine: ms of processor and clock a solution, error in mm/s."""
    state, inputs, commands = network.start, np.zeros(9), 0.4 * np.sign(wanted(0).T.ravel())
    for _ in range(int(network.about["window"])):  # at rest
        state = np.array(network.step(state, inputs)[0]).ravel()
    spent, errors = [], []
    for tick in range(ticks):
        want, in_force = wanted(tick), commands[:3]
        guess = np.concatenate([commands[3:], commands[-3:]])
        began = np.array([time.process_time(), time.perf_counter()])
        commands = controller(state, inputs[:3], in_force, guess, want)
        spent.append(1000 * (np.array([time.process_time(), time.perf_counter()]) - began))
        inputs[3:] = np.array(pilots(ca.DM(commands[:3]))).ravel()
        state, made = (np.array(part).ravel() for part in network.step(state, inputs)[:2])
        inputs[:3] = made
        errors.append(made - want[:, 0])
    return np.array(spent), 1000 * np.abs(errors[ticks // 4 :]).mean()


def main(path, ticks="100"):
    network = Network(path)
    if network.inputs != VELOCITIES + PILOTS or network.about["horizons"] != [{"ticks": 1, "seconds": 0.01}]:
        sys.exit("this example needs a network of examples/mpc.toml: velocities and pilot pressures, one tick ahead")
    carry, feed = np.zeros(9), np.eye(9, 3)
    ways = [
        GaussNewton(network, carry, feed, 1),
        GaussNewton(network, carry, feed, MOST),
        Symbolic(network, carry, feed),
    ]
    for way in ways:
        spent, error = track(network, way, int(ticks))
        processor, clock = np.median(spent, axis=0)
        print(f"{way.name}: {processor:.2f} ms of processor a tick ({clock:.2f} by the clock), off by {error:.2f} mm/s")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    sys.path.insert(0, str(Path(sys.argv[1]).parent))
    from edp_casadi import Network
    from edp_horizon import Horizon

    main(*sys.argv[1:])
