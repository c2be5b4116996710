"""Families of machines: valid by construction, scaled by the stated laws, runnable."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.errors import ConfigError
from edp.sim import DataSetSpec, distribute_over_family, load_machine, machine_family, plan_data_set, simulate
from edp.sim.machine.family import WIDEST, Draws, scale_machine
from edp.sim.machine.machine_checks import check_machine
from edp.sim.physics.plant import Plant


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(10.0, 50.0), st.floats(0.1, WIDEST))
def test_every_member_passes_the_checks(seed, mass_t, scatter):
    draws = Draws(np.random.default_rng(seed), scatter)
    machine = scale_machine(load_machine("M22"), mass_t, draws)
    check_machine(machine, "member")
    check_machine(scale_machine(load_machine("C14"), mass_t, draws, "x", 14.7), "member")


class Middle:
    """Stands in for a generator: every draw is the value that leaves the law alone."""

    def uniform(self, low, high, size=None):
        value = 1.0 if low < 1.0 < high else 0.0 if low < 0.0 < high else low
        return value if size is None else np.full(size, value)


def test_the_laws_of_scaling():
    base = load_machine("M22")
    twice = scale_machine(base, 8 * 21.7, Draws(Middle()))
    assert twice.bodies.length == pytest.approx(2 * np.array(base.bodies.length))
    assert twice.bodies.mass == pytest.approx(8 * np.array(base.bodies.mass))
    assert twice.bodies.inertia == pytest.approx(32 * np.array(base.bodies.inertia))
    assert twice.cylinders.bore == pytest.approx(2 * np.array(base.cylinders.bore))
    assert twice.pumps.max_flow == pytest.approx(4 * base.pumps.max_flow)
    assert twice.valves.meter_in_extend[1] == pytest.approx((4 * 165.0, 14.0))
    assert twice.valves.spool_frequency == pytest.approx(np.array(base.valves.spool_frequency) / np.sqrt(2))


def test_a_family_spreads_over_its_range_and_repeats():
    family = machine_family(12, seed=3)
    length = [m.bodies.length[0] for m in family]
    assert max(length) > 1.4 * min(length)
    assert family == machine_family(12, seed=3)
    assert family[5] == load_machine("family-3-5")
    assert len({m.valves.dead_band_extend for m in family}) == 12
    assert len({m.name for m in family}) == 12


def test_a_range_of_masses_must_make_sense():
    for low, high in ((50.0, 10.0), (0.1, 10.0), (10.0, 1e4), (float("nan"), 20.0)):
        with pytest.raises(ConfigError, match="family of machines"):
            machine_family(2, 0, low, high)


@pytest.mark.parametrize("index", range(4))
def test_members_move_and_stay_bounded(index):
    machine = load_machine(f"family-1-{index}")
    plant = Plant(machine, np.array([0.5, 0.5, 0.5]))
    rng = np.random.default_rng(index)
    before = plant.strokes
    log = plant.run(np.repeat(rng.choice([-1.0, 1.0], (10, 3)), 150, axis=0))
    assert np.isfinite(log).all()
    assert np.abs(plant.strokes - before).max() > 0.05


def test_members_of_another_range_are_loaded_by_name():
    light = machine_family(3, 5, 10.0, 12.5)
    assert [m.name for m in light] == [f"family-5-{i}-10-12p5" for i in range(3)]
    assert load_machine("family-5-2-10-12p5") == light[2]
    assert max(m.bodies.mass[0] for m in light) < load_machine("M22").bodies.mass[0]
    with pytest.raises(ConfigError, match="unknown machine"):
        load_machine("family-5-2-10")


def test_scatter_widens_what_is_not_wear():
    usual, wide = machine_family(20, 3), machine_family(20, 3, scatter=2.0)
    assert usual == machine_family(20, 3, scatter=1.0)
    assert [m.name for m in wide] == [f"family-3-{i}-x2" for i in range(20)]
    assert load_machine("FAMILY-3-4-x2") == wide[4]
    assert load_machine("family-3-4-10-20-x1p5") == machine_family(5, 3, 10.0, 20.0, 1.5)[4]

    def proportions(machines):
        return np.array([np.divide(m.bodies.length, m.bodies.com_y) for m in machines])

    law = np.divide(load_machine("M22").bodies.length, load_machine("M22").bodies.com_y)
    np.testing.assert_allclose(proportions(wide) - law, 2 * (proportions(usual) - law), rtol=1e-9)
    assert [m.pumps.volumetric_efficiency for m in wide] == [m.pumps.volumetric_efficiency for m in usual]
    for scatter in (0.0, -1.0, 2.6, float("nan")):
        with pytest.raises(ConfigError, match="scatter"):
            machine_family(1, 0, scatter=scatter)
        with pytest.raises(ConfigError, match="scatter"):
            DataSetSpec(family=2, scatter=scatter)
    with pytest.raises(ConfigError, match="say how many machines"):
        DataSetSpec(scatter=2.0)


def test_a_data_set_of_a_family_takes_turns():
    plan = distribute_over_family(plan_data_set("M22", 1.0, 6, seed=2), 3, seed=2)
    assert {s.machine for s in plan} == {f"family-2-{i}" for i in range(3)}
    assert len({s.name for s in plan}) == 6
    recording = simulate(dataclasses.replace(plan[0], duration_s=2.0))
    assert recording.source.startswith("sim:family-2-")
    with pytest.raises(ConfigError, match="family = -1"):
        distribute_over_family(plan, -1, seed=2)
