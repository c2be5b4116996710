"""Valves, chambers and friction element by element."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.sim import load_machine
from edp.sim.excitation.base import extend_probability
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import conductance, pack
from edp.sim.physics import friction, hydraulics, linkage, pump, valve

AXES, PLANT = pack(load_machine("M22"))


def viscous(i):
    return AXES[i, at.VISCOUS] * PLANT[at.VISCOUS_SHARE]


few = settings(max_examples=40, deadline=None)
pressure = st.floats(-0.9e5, 400e5)


@few
@given(st.floats(-400e5, 400e5))
def test_orifice_is_odd_rising_and_has_its_slope(dp):
    flow, slope = hydraulics.orifice(dp)
    assert flow == pytest.approx(-hydraulics.orifice(-dp)[0])
    assert slope > 0
    step = 1.0 + 1e-5 * abs(dp)
    numeric = (hydraulics.orifice(dp + step)[0] - hydraulics.orifice(dp - step)[0]) / (2 * step)
    assert slope == pytest.approx(numeric, rel=1e-4)
    if abs(dp) > 20e5:
        assert abs(flow) == pytest.approx(abs(dp) ** 0.5, rel=1e-2)


@few
@given(pressure)
def test_port_flow_pushes_pressure_back(p):
    flow, slope = hydraulics.port_flows(p, 370e5, 1e-14, PLANT)
    assert slope <= 0
    assert (flow > 0) == (p < PLANT[at.TANK]) or flow == 0
    if p > 375e5:
        assert flow < -1e-4


@few
@given(pressure)
def test_oil_softens_with_free_air(p):
    assert 0 < hydraulics.stiffness(p, PLANT) <= PLANT[at.BULK_MODULUS] * 1.01
    assert hydraulics.stiffness(p + 1e5, PLANT) >= hydraulics.stiffness(p, PLANT)


@few
@given(st.integers(0, 2), st.floats(-1.0, 1.0), st.floats(-2e-3, 2e-3))
def test_friction_slopes_match_differences(i, v, z):
    force, _, force_by_z, force_by_v, rate_by_z, rate_by_v = friction.lugre(v, z, AXES, i, viscous(i))
    if abs(v) > 1e-5:
        above, below = (
            friction.lugre(v + 1e-7, z, AXES, i, viscous(i)),
            friction.lugre(v - 1e-7, z, AXES, i, viscous(i)),
        )
        scale = 1e-4 * (abs(force) + AXES[i, at.SIGMA0] * 1e-4)
        assert force_by_v == pytest.approx((above[0] - below[0]) / 2e-7, rel=1e-3, abs=scale)
        assert rate_by_v == pytest.approx((above[1] - below[1]) / 2e-7, rel=1e-3, abs=1e-2)
    above, below = friction.lugre(v, z + 1e-8, AXES, i, viscous(i)), friction.lugre(v, z - 1e-8, AXES, i, viscous(i))
    assert force_by_z == pytest.approx((above[0] - below[0]) / 2e-8, rel=1e-3, abs=1e3)
    assert rate_by_z == pytest.approx((above[1] - below[1]) / 2e-8, rel=1e-3, abs=1e-3)


@few
@given(st.integers(0, 2), st.floats(0.02, 1.0))
def test_steady_friction_is_stribeck(i, v):
    level = AXES[i, at.COULOMB] + (AXES[i, at.STATIC] - AXES[i, at.COULOMB]) * np.exp(
        -((v / AXES[i, at.STRIBECK]) ** 2)
    )
    force, rate, *_ = friction.lugre(v, level / AXES[i, at.SIGMA0], AXES, i, viscous(i))
    assert rate == pytest.approx(0.0, abs=1e-9)
    assert force == pytest.approx(level + viscous(i) * v)


@few
@given(st.integers(0, 2), st.floats(-0.03, 0.03), st.floats(-1.0, 1.0))
def test_stops_push_and_never_pull(i, beyond, v):
    top = AXES[i, at.STROKE]
    assert friction.end_stop(-abs(beyond), v, AXES, i)[0] >= 0
    assert friction.end_stop(top + abs(beyond), v, AXES, i)[0] <= 0
    assert friction.end_stop(0.5 * top, v, AXES, i) == (0.0, 0.0)
    assert friction.end_stop(-abs(beyond), v, AXES, i)[1] <= 0


@few
@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_demands_are_shaped_by_direction(lever):
    out = np.zeros(6)
    valve.shape_demand(np.array(lever), AXES, PLANT, out)
    for i in range(3):
        assert abs(out[i]) <= 1
        assert abs(out[i + 3]) <= abs(out[i]) + 1e-12
        assert out[i] == 0 or (out[i] > 0) == (lever[i] > 0)
    assert out[3] >= -0.021


@few
@given(st.floats(-1, 1))
def test_openings_are_closed_in_the_dead_band(spool):
    area = valve.opening(spool, 0.14)
    assert 0 <= area <= 1
    assert (area == 0) == (abs(spool) <= 0.14)


@few
@given(st.integers(0, 2), st.floats(0.0, 1.0))
def test_angle_at_stroke_inverts_the_linkage(i, share):
    stroke = share * AXES[i, at.STROKE]
    psi = linkage.angle_at_stroke(i, stroke, AXES, PLANT)
    assert linkage.cylinder(i, psi, PLANT)[0] - AXES[i, at.CLOSED] == pytest.approx(stroke, abs=1e-9)


def test_filters_settle_on_the_demand_within_the_play():
    valves, demand = np.zeros((6, 5)), np.array([0.8, -0.5, 0.3, 0.6, -0.2, 0.0])
    filters = valve.spool_filters(load_machine("M22"), 5e-4)
    for _ in range(2000):
        valve.pilot_half_step(demand, filters, AXES, valves)
        valve.spool_half_step(filters, valves)
    np.testing.assert_allclose(valves[:, at.PILOT], demand, atol=1e-6)
    np.testing.assert_allclose(valves[:, at.SPOOL], demand, atol=0.0121)


def test_pumps_share_the_power_limit():
    state, valves = np.zeros(at.STATES), np.zeros((6, 5))
    valves[:, at.PILOT] = 1.0
    state[at.PUMP : at.PUMP + 2] = 300e5
    for _ in range(100):
        pump.displacement_step(state, valves, AXES, PLANT, 0.9)
    power = PLANT[at.MAX_FLOW] * (state[at.DISPLACEMENT : at.DISPLACEMENT + 2] @ state[at.PUMP : at.PUMP + 2])
    assert power == pytest.approx(PLANT[at.POWER_LIMIT], rel=1e-3)


def test_conductance_meets_its_rating():
    assert conductance((60.0, 25.0)) * np.sqrt(25e5) == pytest.approx(1e-3)


def test_the_operator_heads_back_to_the_middle():
    chances = [extend_probability(s) for s in (0.0, 0.3, 0.5, 0.7, 1.0)]
    assert chances == sorted(chances, reverse=True)
    assert chances[2] == 0.5
