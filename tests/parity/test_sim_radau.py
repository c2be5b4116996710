"""The split ROS2 integrator against SciPy's Radau on a plain NumPy model, written from the machine file alone."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.layout import LOG_VELOCITY
from edp.sim.physics.plant import Plant

ATM = 1.013e5
LEVERS = ((0.6, -0.45, 0.5), (-0.35, 0.7, -0.3), (0.0, 0.0, 0.0))
PIECE_S = 0.4


def smooth(machine):
    """Without dead time and play, which no ordinary differential equation has, and oil that stays as warm as it is."""
    valves = dataclasses.replace(machine.valves, dead_time=(0.0,) * 3, conflux_extra_dead_time=0.0, hysteresis=0.0)
    oil = dataclasses.replace(machine.oil, heat_capacity=1e15)
    return dataclasses.replace(machine, valves=valves, oil=oil)


class Reference:
    """Right-hand side of plant, pilots and spools; state as in section 3 of the model, pilots and spools behind it.

    Last, where a machine has long lines, their pressures at the valve and their flows.
    """

    def __init__(self, machine, levers):
        self.m = machine
        m, v = machine, machine.valves
        zone, start = v.lever_dead_zone, v.conflux_start
        size = np.maximum(np.abs(levers) - zone, 0) / (1 - zone)
        second = np.clip((size - start) / (1 - start), 0, 1)
        share = np.where(np.array(levers) > 0, v.conflux_extend, v.conflux_retract)
        self.demand = np.concatenate((np.sign(levers) * size, np.sign(levers) * second * share))
        bore, rod, n = (np.array(x) for x in (m.cylinders.bore, m.cylinders.rod, m.cylinders.count))
        self.head_area, self.rod_area = n * math.pi * bore**2 / 4, n * math.pi * (bore**2 - rod**2) / 4
        self.stroke = np.array(m.cylinders.stroke)
        self.thin = math.exp(0.035 * (m.oil.temperature - 40))
        self.long = any(m.cylinders.line_bore)

    @staticmethod
    def k(rating):
        return rating[0] / 6e4 / math.sqrt(rating[1] * 1e5)

    @staticmethod
    def orifice(dp):
        return dp * (dp * dp + 1e10) ** -0.25

    def check(self, dp):
        return self.orifice(dp) * (1.0 if dp >= 0 else self.m.valves.check_leakage)

    def length(self, i, psi):
        if i < 2:
            c = (self.m.boom_cylinder, self.m.arm_cylinder)[i]
            phi = math.radians(c.offset_deg) + (psi if i == 0 else -psi)
            return abs(c.base_radius - c.rod_radius * np.exp(1j * phi))
        b = self.m.bucket_linkage
        pin = self.m.bodies.length[1]
        pivot = complex(pin - b.pivot_to_pin, b.pivot_offset)
        lug = pin + b.lug * np.exp(1j * (psi + b.lug_angle))
        d = abs(lug - pivot)
        corner = math.acos((b.rocker**2 + d**2 - b.link**2) / (2 * b.rocker * d))
        end = pivot + b.rocker * (lug - pivot) / d * np.exp(1j * corner)
        return abs(end - complex(*b.cylinder_pin))

    def bodies(self, psi, rate):
        """Mass matrix and bias from point Jacobians of the centres of mass, in the complex plane."""
        b = self.m.bodies
        angle = np.cumsum(psi)
        spin = np.cumsum(rate)
        unit = np.exp(1j * angle)
        mass, bias = np.zeros((3, 3)), np.zeros(3)
        for i in range(3):
            arms = [b.length[j] * unit[j] for j in range(i)] + [complex(b.com_x[i], b.com_y[i]) * unit[i]]
            jac = np.zeros(3, complex)
            for j in range(i + 1):
                jac[j] = 1j * sum(arms[j:])
            turn = (np.arange(3) <= i).astype(float)
            accel = -sum(a * spin[j] ** 2 for j, a in enumerate(arms)) + 1j * self.m.gravity
            mass += b.mass[i] * np.real(np.outer(jac, jac.conj())) + b.inertia[i] * np.outer(turn, turn)
            bias += b.mass[i] * np.real(jac.conj() * accel)
        return mass, bias

    def openings(self, i, spool, conflux, stroke):
        v = self.m.valves

        def area(s, band):
            r = min(max((abs(s) - band) / (1 - band), 0), 1)
            return r * (0.25 + 0.75 * r)

        out = spool > 0
        a = area(spool, (v.dead_band_extend if out else v.dead_band_retract)[i])
        a2 = area(conflux, (v.conflux_dead_band_extend if conflux > 0 else v.conflux_dead_band_retract)[i])
        r = min(max(((self.stroke[i] - stroke) if out else stroke) / self.m.cylinders.cushion_length[i], 0), 1)
        least = self.m.cylinders.cushion_area[i]
        left = least + (1 - least) * r * r * (3 - 2 * r)
        main = self.k((v.meter_in_extend if out else v.meter_in_retract)[i]) * a
        second = self.k((v.conflux_in_extend if conflux > 0 else v.conflux_in_retract)[i]) * a2
        drain = self.k((v.meter_out_extend if out else v.meter_out_retract)[i]) * a * left
        regen = self.k((v.regeneration_extend if out else v.regeneration_retract)[i]) * a * left
        return main, second, drain, regen

    def flows(self, i, p, spools, stroke):
        """Head and rod inflow and the flow drawn from each pump; p = head, rod, pump 1, pump 2."""
        m, v = self.m, self.m.valves
        spool, conflux = spools[i], spools[i + 3]
        main, second, drain, regen = self.openings(i, spool, conflux, stroke)
        q, drawn = np.zeros(2), np.zeros(2)
        for k, s, pump in ((main, spool, int(v.primary_pump[i]) - 1), (second, conflux, int(v.conflux_pump[i]) - 1)):
            side = 0 if s > 0 else 1
            flow = k * self.check(p[2 + pump] - p[side])
            q[side] += flow
            drawn[pump] += flow
        side = 1 if spool > 0 else 0
        q[side] -= drain * self.orifice(p[side] - m.oil.tank_pressure)
        across = regen * self.check(p[side] - p[1 - side])
        q[side] -= across
        q[1 - side] += across
        if not self.long:
            leak = m.cylinders.piston_leakage[i] * self.thin * (p[0] - p[1])
            q += np.array([-leak, leak])
        for side, relief in enumerate((v.port_relief_head[i], v.port_relief_rod[i])):
            q[side] -= m.cylinders.spool_leakage[i] * self.thin * (p[side] - m.oil.tank_pressure)
            q[side] -= v.port_relief_slope * max(p[side] - relief, 0)
            q[side] += self.k(v.anti_cavitation) * self.orifice(max(m.oil.tank_pressure - p[side], 0))
        return q, drawn

    def bulk(self, p):
        a = self.m.oil.air_fraction * ATM / (p + ATM)
        beta = self.m.oil.bulk_modulus * (1 - 0.004 * (self.m.oil.temperature - 45))
        return (1 + a) / (1 / beta + a / (p + ATM))

    def friction(self, i, v, z):
        f = self.m.friction
        scale = self.head_area[i] * 343e5
        fade = math.exp(-((v / f.stribeck_velocity) ** 2))
        g = scale * (f.coulomb_fraction + (f.static_fraction - f.coulomb_fraction) * fade)
        z_rate = v - f.bristle_stiffness[i] * abs(v) * z / g
        viscous = f.viscous[i] * math.exp(-0.0175 * (self.m.oil.temperature - 40))
        return f.bristle_stiffness[i] * z + f.bristle_damping[i] * fade * z_rate + viscous * v, z_rate

    def pumps(self, y, pilots, spools, drawn):
        m, v = self.m, self.m.valves
        asked, bypass = np.full(2, m.pumps.min_displacement), np.ones(2)
        for j in range(len(pilots)):
            if j < 6:
                pump = (v.primary_pump if j < 3 else v.conflux_pump)[j % 3] - 1
                gain = (v.pump_demand_extend if pilots[j] >= 0 else v.pump_demand_retract)[j % 3]
            else:
                pump, gain = self.fed[j - 6]
            asked[pump] = max(asked[pump], min(gain * max(abs(pilots[j]) - 0.1, 0) / 0.75, 1))
            bypass[pump] *= max(1 - abs(spools[j]) / m.pumps.bypass_closed_at, 0) ** 2
        p, d = y[12:14], y[17:19]
        limit = min(1.0, m.pumps.power_limit / max(m.pumps.max_flow * float(asked @ np.maximum(p, 0)), 1.0))
        lost = np.array([self.orifice(x - m.oil.tank_pressure) for x in p]) * bypass * self.k(m.pumps.bypass)
        lost += m.pumps.relief_slope * np.maximum(p - m.pumps.relief, 0)
        supply = m.pumps.volumetric_efficiency * m.pumps.max_flow * d
        p_rate = np.array([self.bulk(x) for x in p]) / m.pumps.line_volume * (supply - lost - drawn)
        return p_rate, (asked * limit - d) / m.pumps.time_constant

    def chambers(self, i, y, v, stroke, q):
        """Rates of head and rod pressure, and of both lines' ends at the valve and flows where there are lines."""
        c, ends = self.m.cylinders, np.array([self.head_area[i], self.rod_area[i]])
        volume = c.dead_length * ends + c.hose_volume[i] + ends * np.array([stroke, self.stroke[i] - stroke])
        p, swept = y[[6 + i, 9 + i]], np.array([-1.0, 1.0]) * ends * v
        if not self.long:
            return np.array([self.bulk(x) for x in p]) / volume * (q + swept), np.zeros(4)
        half, bore = c.hose_volume[i] / 2, c.line_bore[i]
        area = math.pi * bore**2 / 4
        length = c.hose_volume[i] / area
        give = half / c.line_modulus[i] if c.line_modulus[i] else 0.0
        port, flow = y[[43 + i, 46 + i]], y[[49 + i, 52 + i]]
        leak = c.piston_leakage[i] * self.thin * (p[0] - p[1]) * np.array([-1.0, 1.0])
        nu = self.m.oil.viscosity / self.thin
        reynolds = np.abs(flow) / area * bore / nu
        factor = np.maximum(64.0 / np.maximum(reynolds, 1e-9), 0.3164 / np.maximum(reynolds, 1e-9) ** 0.25)
        drop = factor * length / bore * 860.0 / 2 * flow * np.abs(flow) / area**2
        stiff = [1 / (room / self.bulk(x) + give) for room, x in zip((*(volume - half), half, half), (*p, *port))]
        lines = np.concatenate((np.array(stiff[2:]) * (q - flow), (port - p - drop) * area / (860.0 * length)))
        return np.array(stiff[:2]) * (flow + leak + swept), lines

    def __call__(self, t, y):
        m = self.m
        out = np.zeros_like(y)
        psi, rate = y[:3], y[3:6]
        pilots, spools = y[19:31].reshape(2, 6), y[31:43].reshape(2, 6)
        mass, bias = self.bodies(psi, rate)
        torque, drawn = -bias, np.zeros(2)
        for i in range(3):
            d = 1e-5
            lever = (self.length(i, psi[i] + d) - self.length(i, psi[i] - d)) / (2 * d)
            closed = (m.boom_cylinder, m.arm_cylinder, m.bucket_linkage)[i].closed_length
            stroke, v = self.length(i, psi[i]) - closed, lever * rate[i]
            seen = 43 if self.long else 6
            q, taken = self.flows(i, np.array([y[seen + i], y[seen + 3 + i], y[12], y[13]]), spools[0], stroke)
            drawn += taken
            out[[6 + i, 9 + i]], lines = self.chambers(i, y, v, stroke, q)
            if self.long:
                out[[43 + i, 46 + i, 49 + i, 52 + i]] = lines
            drag, out[14 + i] = self.friction(i, v, y[14 + i])
            torque[i] += lever * (self.head_area[i] * y[6 + i] - self.rod_area[i] * y[9 + i] - drag)
        out[:3], out[3:6] = rate, np.linalg.solve(mass, torque)
        out[12:14], out[17:19] = self.pumps(y, pilots[0], spools[0], drawn)
        valves = m.valves
        w = 2 * math.pi * np.array(valves.pilot_frequency * 2)
        out[19:25], out[25:31] = pilots[1], w**2 * (self.demand - pilots[0]) - 2 * 0.9 * w * pilots[1]
        w = 2 * math.pi * np.array(valves.spool_frequency + valves.conflux_spool_frequency)
        out[31:37], out[37:43] = spools[1], w**2 * (pilots[0] - spools[0]) - 2 * w * spools[1]
        return out


class Moving(Reference):
    """With swing and tracks; behind 43 states their angles, speeds, pressures of both ports, pilots and spools."""

    def __init__(self, machine, levers):
        super().__init__(machine, levers[:3])
        self.motors = machine.swing, machine.travel, machine.travel
        pumps = machine.swing.pump, machine.travel.pump, 3 - machine.travel.pump
        self.fed = [(pump - 1, motor.pump_demand) for pump, motor in zip(pumps, self.motors)]
        zone = machine.valves.lever_dead_zone
        self.asked = np.sign(levers[3:]) * np.maximum(np.abs(levers[3:]) - zone, 0) / (1 - zone)

    def inertia(self, psi):
        b, place, total = self.m.bodies, complex(self.m.swing.boom_foot_ahead), self.m.swing.inertia
        for k, angle in enumerate(np.cumsum(psi)):
            turn = np.exp(1j * angle)
            total += b.mass[k] * (place + complex(b.com_x[k], b.com_y[k]) * turn).real ** 2
            total += b.inertia[k] * turn.real**2
            place += b.length[k] * turn
        return total

    def bodies(self, psi, rate):
        """The front feels half of the swing's speed squared times the slope of its inertia."""
        d = 1e-5
        self.slopes = np.array([(self.inertia(psi + e) - self.inertia(psi - e)) / (2 * d) for e in d * np.eye(3)])
        mass, bias = super().bodies(psi, rate)
        return mass, bias - 0.5 * self.speed**2 * self.slopes

    def pumps(self, y, pilots, spools, drawn):
        """The motors' sections beside those of the cylinders."""
        (speed, a, b), (pilot, spool) = y[46:55].reshape(3, 3), y[[range(55, 58), range(61, 64)]]
        drawn, self.flows_in = drawn.copy(), np.zeros((2, 3))
        tank, v = self.m.oil.tank_pressure, self.m.valves
        for i, motor in enumerate(self.motors):
            r = min(max((abs(spool[i]) - motor.dead_band) / (1 - motor.dead_band), 0), 1)
            area, pump = r * (0.25 + 0.75 * r), self.fed[i][0]
            ports = (a[i], b[i]) if spool[i] > 0 else (b[i], a[i])
            into = self.k(motor.meter_in) * area * self.check(y[12 + pump] - ports[0])
            away = self.k(motor.meter_out) * area * self.orifice(ports[1] - tank)
            drawn[pump] += into
            flows = np.array([into, -away]) if spool[i] > 0 else np.array([-away, into])
            through = motor.leakage * self.thin * (a[i] - b[i]) + motor.displacement * speed[i]
            flows += np.array([-through, through])
            for n, p in enumerate((a[i], b[i])):
                flows[n] -= motor.drain_leakage * self.thin * (p - tank)
                flows[n] -= motor.relief_slope * max(p - motor.relief, 0)
                flows[n] += self.k(v.anti_cavitation) * self.orifice(max(tank - p, 0))
            self.flows_in[:, i] = flows
        return super().pumps(y, np.concatenate((pilots, pilot)), np.concatenate((spools, spool)), drawn)

    def __call__(self, t, y):
        (speed, a, b) = y[46:55].reshape(3, 3)
        pilot, pilot_rate, spool, spool_rate = y[55:67].reshape(4, 3)
        self.speed = speed[0]
        out = super().__call__(t, y)
        out[43:46] = speed
        for i, m in enumerate(self.motors):
            drag = m.coulomb * speed[i] / math.hypot(speed[i], 5e-3) + m.viscous * speed[i]
            torque, moved = m.displacement * (a[i] - b[i]) - drag, m.inertia
            if i == 0:
                moved = self.inertia(y[:3])
                torque -= speed[0] * self.slopes @ y[3:6]
            out[46 + i] = torque / moved
            stiff = np.array([self.bulk(a[i]), self.bulk(b[i])]) / m.volume
            out[[49 + i, 52 + i]] = stiff * self.flows_in[:, i]
            w = 2 * math.pi * m.pilot_frequency
            out[55 + i], out[58 + i] = pilot_rate[i], w**2 * (self.asked[i] - pilot[i]) - 2 * 0.9 * w * pilot_rate[i]
            w = 2 * math.pi * m.spool_frequency
            out[61 + i], out[64 + i] = spool_rate[i], w**2 * (pilot[i] - spool[i]) - 2 * w * spool_rate[i]
        return out


def machine_of(name):
    """A machine by its name; with "lines" behind it, of 25, 25 and 20 mm, rigid at the boom, hoses elsewhere.

    With "motors" without dead time of their commands and without brakes, which would fall in within an instant.
    """
    machine = smooth(load_machine(name.split()[0]))
    if "motors" in name:
        swing, travel = (dataclasses.replace(m, dead_time=0.0, brake=0.0) for m in (machine.swing, machine.travel))
        return dataclasses.replace(machine, swing=swing, travel=travel)
    if "lines" not in name:
        return machine
    lines = {"line_bore": (0.025, 0.025, 0.020), "line_modulus": (0.0, 6e8, 6e8)}
    return dataclasses.replace(machine, cylinders=dataclasses.replace(machine.cylinders, **lines))


def run_plant(name, step_s, pieces=LEVERS):
    plant = Plant(machine_of(name), np.array([0.45, 0.5, 0.5]), step_s=step_s, moves="motors" in name)
    start = plant.state.copy()
    levers = np.repeat(np.array(pieces), round(PIECE_S * 100), axis=0)
    return start, plant.run(np.concatenate((levers, levers[-1:])))


@pytest.fixture(scope="module", params=["M22", "C14"])
def name(request):
    return request.param


def integrate(name, pieces, tolerance):
    """States of the reference at 100 Hz, a row each, the start first."""
    start, _ = run_plant(name, 1e-3, pieces[:1])
    machine, plant_states = machine_of(name), at.LOGGED_STATES
    model = Moving if "motors" in name else Reference
    still = np.concatenate((np.zeros(6), np.full(6, machine.oil.tank_pressure), np.zeros(12)))
    behind = start[plant_states:] if "lines" in name else still if "motors" in name else ()
    y = np.concatenate((start[:plant_states], np.zeros(24), behind))
    rows = [y[None]]
    times = np.arange(1, round(PIECE_S * 100) + 1) / 100
    sizes = scales(tolerance)[: len(y)]
    if "motors" in name:
        sizes = np.concatenate((sizes[:43], tolerance * np.repeat([0.1, 1e6, 0.1], (6, 6, 12))))
    limits = {"rtol": tolerance, "atol": sizes, "first_step": 1e-5}
    for levers in pieces:
        found = solve_ivp(model(machine, np.array(levers)), (0, PIECE_S), y, "Radau", t_eval=times, **limits)
        rows.append(found.y.T)
        y = found.y[:, -1]
    return np.concatenate(rows)


@pytest.fixture(scope="module")
def reference(name):
    return integrate(name, LEVERS, 1e-6)


def scales(tolerance):
    """Absolute tolerances by the size of each state."""
    sizes = np.concatenate((np.full(6, 0.1), np.full(8, 1e6), np.full(3, 1e-3), np.full(26, 0.1)))
    sizes = np.concatenate((sizes, np.full(6, 1e6), np.full(6, 1e-4)))
    return tolerance * sizes


def velocities(name, rows):
    """Cylinder velocities from angles and rates, m/s, with the reference's own lever arms."""
    model = Reference(machine_of(name), (0.0, 0.0, 0.0))
    arms = [[(model.length(i, r[i] + 1e-5) - model.length(i, r[i] - 1e-5)) / 2e-5 for i in range(3)] for r in rows]
    return np.array(arms) * rows[:, 3:6]


def differences(name, log, rows):
    """Root mean square of speed (m/s) and pressure (Pa) differences, by signal."""
    speed = log[:, LOG_VELOCITY : LOG_VELOCITY + 3] - velocities(name, rows)
    pressure = log[:, at.HEAD : at.BRISTLE] - rows[:, at.HEAD : at.BRISTLE]
    return np.sqrt(np.mean(speed**2, axis=0)), np.sqrt(np.mean(pressure**2, axis=0))


def test_one_millisecond_matches_radau(name, reference):
    _, log = run_plant(name, 1e-3)
    assert log[:, LOG_VELOCITY : LOG_VELOCITY + 3].std(axis=0).min() > 0.03
    speed, pressure = differences(name, log, reference)
    assert speed.max() < 0.05e-3
    assert pressure.max() < 0.1e5


def test_long_lines_match_radau():
    name, pieces = "M22 lines", LEVERS[:1]
    _, log = run_plant(name, 1e-3, pieces)
    rows = integrate(name, pieces, 1e-6)
    speed, pressure = differences(name, log, rows)
    assert np.abs(log[:, at.LOG_PORT : at.LOG_PORT + 6] - log[:, at.HEAD : at.PUMP]).max() > 3e5
    ports = np.sqrt(np.mean((log[:, at.LOG_PORT : at.LOG_PORT + 6] - rows[:, 43:49]) ** 2, axis=0))
    assert speed.max() < 0.05e-3
    assert max(pressure.max(), ports.max()) < 0.1e5


def test_swing_and_travel_match_radau():
    """Front, swing and both tracks at once: speeds (rad/s, m/s) and pressures of every motor."""
    name, pieces = "M22 motors", ((0.6, -0.45, 0.5, 0.9, 0.7, -0.6),)
    _, log = run_plant(name, 1e-3, pieces)
    rows = integrate(name, pieces, 1e-6)
    speed, pressure = differences(name, log, rows)
    motors = log[:, at.LOG_COLUMNS :]
    turned = np.sqrt(np.mean((motors[:, :3] - rows[:, 46:49]) ** 2, axis=0))
    ports = np.sqrt(np.mean((motors[:, 3:9] - rows[:, 49:55]) ** 2, axis=0))
    assert (np.abs(motors[:, :3]).max(axis=0) > 0.05).all()
    assert speed.max() < 0.05e-3
    assert turned.max() < 0.1e-3
    assert max(pressure.max(), ports.max()) < 0.1e5


@pytest.mark.slow
def test_eight_seconds_match_radau_at_a_tight_tolerance(name):
    pieces = tuple(map(tuple, np.random.default_rng(3).uniform(-0.7, 0.7, (20, 3))))
    _, log = run_plant(name, 1e-3, pieces)
    speed, pressure = differences(name, log, integrate(name, pieces, 1e-8))
    assert speed.max() < 0.05e-3
    assert pressure.max() < 0.1e5


@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_convergence_is_second_order(machine):
    """Mean over three halvings: a single one also shows where a check or a dead band falls within a step."""
    steps = [1e-3 / 2**n for n in range(5)]
    runs = [run_plant(machine, h)[1][:, LOG_VELOCITY : LOG_VELOCITY + 3] for h in steps]
    apart = [float(np.sqrt(np.mean((a - b) ** 2))) for a, b in itertools.pairwise(runs)]
    assert 1.8 < math.log2(apart[0] / apart[-1]) / 3 < 2.2
