"""Scores of loops against cases worked out by hand."""

import numpy as np
import pytest

from edp.control.limits import LoopLimits
from edp.control.reference import TipReference
from edp.control.score import LoopTrace, path_distance, scored

TICKS = 11


def straight(rate=10.0, judged=None):
    """One metre along x in one second at an attitude of -90 degrees."""
    tip = np.zeros((TICKS, 3))
    tip[:, 0] = np.linspace(0.0, 1.0, TICKS)
    tip[:, 2] = -np.pi / 2
    mask = np.ones(TICKS, bool) if judged is None else judged
    return TipReference(rate, np.full((TICKS, 3), 0.5), tip, mask)


def trace(tip, levers=None, strokes=0.5, pressures=None, power=None):
    ticks = len(tip)
    return LoopTrace(
        tip,
        np.full((ticks, 3), strokes),
        np.zeros((ticks, 3)) if levers is None else levers,
        np.zeros((ticks, 0)) if pressures is None else pressures,
        power,
    )


def test_standing_still_is_no_error_of_the_path_but_one_of_the_position():
    reference = straight()
    score = scored(trace(np.repeat(reference.tip[:1], TICKS, axis=0)), reference, LoopLimits())
    assert score.path_max_mm == 0.0
    # Distances are 0, 0.1, ... 1.0 m: the mean of the squares is 0.35.
    assert score.position_rms_mm == pytest.approx(1e3 * np.sqrt(0.35))
    assert score.position_max_mm == pytest.approx(1000.0)
    assert score.arrived_s is None


def test_a_tip_beside_the_path_has_that_distance_and_a_late_one_has_none_of_it():
    reference = straight()
    beside = reference.tip + np.array([0.0, 0.02, 0.0])
    score = scored(trace(beside), reference, LoopLimits())
    assert score.path_rms_mm == pytest.approx(20.0)
    assert score.position_rms_mm == pytest.approx(20.0)
    late = reference.tip.copy()
    late[1:] = reference.tip[:-1]
    score = scored(trace(late), reference, LoopLimits())
    assert score.path_rms_mm == pytest.approx(0.0, abs=1e-9)
    assert score.position_p95_mm == pytest.approx(100.0)


def test_attitude_errors_do_not_depend_on_the_turn_they_are_counted_in():
    reference = straight()
    turned = reference.tip + np.array([0.0, 0.0, 2 * np.pi + np.radians(3.0)])
    assert scored(trace(turned), reference, LoopLimits()).attitude_rms_deg == pytest.approx(3.0)


def test_the_lead_in_is_not_judged():
    judged = np.arange(TICKS) >= 5
    reference = straight(judged=judged)
    tip = reference.tip.copy()
    tip[:5, 1] = 9.0
    assert scored(trace(tip), reference, LoopLimits()).position_max_mm == pytest.approx(0.0, abs=1e-9)


def test_the_tip_has_arrived_when_it_stays_near_the_end():
    reference = straight()
    tip = reference.tip.copy()
    tip[7] = reference.tip[-1]
    # At tick 7 it is there for one tick only; it stays from tick 10 on.
    assert scored(trace(tip), reference, LoopLimits()).arrived_s == pytest.approx(1.0)
    tip[7:] = reference.tip[-1]
    assert scored(trace(tip), reference, LoopLimits()).arrived_s == pytest.approx(0.7)


def test_energy_and_lever_travel_are_sums():
    reference = straight()
    levers = np.zeros((TICKS, 3))
    levers[3:, 0], levers[5:7, 2] = 0.4, -0.1
    power = np.full(TICKS, 5_000.0)
    score = scored(trace(reference.tip, levers, power=power), reference, LoopLimits())
    assert score.energy_kj == pytest.approx(11 * 0.1 * 5.0)
    assert score.lever_travel == pytest.approx(0.4 + 0.1 + 0.1)
    assert scored(trace(reference.tip), reference, LoopLimits()).energy_kj is None


def test_each_limit_counts_the_ticks_at_which_it_was_violated():
    reference, limits = straight(), LoopLimits(stroke_margin=0.1, pressure_pa=30e6, slew_per_s=(2.0, 2.0, 2.0))
    levers = np.zeros((TICKS, 3))
    # A step of 0.4 in a tenth of a second is 4 per second, there and back; -1.1 is beyond the range as well.
    levers[4, 1], levers[8:, 2] = 0.4, -1.1
    pressures = np.full((TICKS, 6), 10e6)
    pressures[2:4, 5] = 31e6
    score = scored(trace(reference.tip, levers, 0.95, pressures), reference, limits)
    assert dict(score.violations) == {"lever": 3, "slew": 3, "stroke": TICKS, "pressure": 2}


def test_a_loop_that_broke_off_is_scored_as_far_as_it_came():
    reference = straight()
    score = scored(trace(reference.tip[:4]), reference, LoopLimits(), missed=2)
    assert not score.finished
    assert score.missed == 2
    assert score.arrived_s is None
    assert score.position_max_mm == 0.0


def test_distances_to_a_polyline_are_those_to_its_nearest_place():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    points = np.array([[0.5, 0.2], [-3.0, 4.0], [1.5, 0.5], [1.0, 3.0], [0.9, 0.1]])
    assert path_distance(points, path) == pytest.approx([0.2, 5.0, 0.5, 2.0, 0.1])
    assert path_distance(points, path[:1]) == pytest.approx(np.hypot(*points.T))
    fine = np.stack([np.linspace(0.0, 1.0, 5001), np.zeros(5001)], axis=1)
    assert path_distance(np.array([[0.5, 0.25]]), fine) == pytest.approx([0.25])
