"""The monitor's benchmark in small: sessions of its generator, its metrics, and its rivals on made-up rows."""

import sys
from pathlib import Path

import numpy as np
import pytest

from edp.sim.faults import FAULTS, ladder, parse_fault
from edp.sim.machine.machine_files import load_machine

FOLDER = Path(__file__).parents[2] / "benchmarks"
NAMES = ("monitor_sessions", "monitor_metrics", "monitor_rivals")


@pytest.fixture(scope="module")
def bench():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import monitor_metrics
        import monitor_rivals
        import monitor_sessions

        yield monitor_sessions, monitor_metrics, monitor_rivals
        for name in NAMES:
            sys.modules.pop(name, None)


def test_seeds_of_parts_and_groups_are_apart(bench):
    sessions = bench[0]
    seen = [plan.seed for part, counts in sessions.COUNTS.items() for plan in sessions.plans_of(part, counts)]
    assert len(seen) == len(set(seen))
    names = [plan.name for plan in sessions.plans_of("test", sessions.COUNTS["test"])]
    assert len(names) == len(set(names))


def test_every_size_of_every_kind_is_drawn_as_often(bench):
    texts = bench[0].faults_of_draws(2, seed=3)
    specs = [parse_fault(text) for text in texts]
    wanted = sorted((fault.kind, fault.size or 0.0) for fault in ladder() for _ in range(2))
    assert sorted((spec.kind, spec.size or 0.0) for spec in specs) == wanted
    assert {spec.onset_s for spec in specs} == {120.0}
    assert {spec.kind for spec in specs} == set(FAULTS)
    assert len({spec.site for spec in specs if spec.kind == "pilot_bias"}) > 1


def test_sessions_come_back_with_what_is_measured_and_when_it_moved(bench, tmp_path):
    sessions = bench[0]
    plans = sessions.session_plans("validation", "healthy", 1, seconds=8.0)
    stuck = sessions.SessionPlan("faulty_0", "faulty", 5, 40.0, 20.0, "clay", 0.0, "stroke_stuck:arm@2s", 8.0)
    sessions.write_sessions([*plans, stuck], tmp_path)
    assert sessions.session_names(tmp_path, "healthy") == ["healthy_000"]
    (healthy,) = sessions.read_sessions(tmp_path, "healthy")
    again = sessions.simulated(plans[0], tmp_path / "machines")
    assert np.array_equal(healthy.recording.values, again.recording.values)
    assert healthy.recording.channel_names == sessions.CHANNELS
    assert healthy.recording.values.shape == (800, 30)
    assert len(healthy.moving) == 8
    faulty = sessions.read_session(tmp_path, "faulty_0")
    stroke = faulty.recording.column("CylStroke_2")
    assert np.ptp(stroke[200:]) == 0.0
    assert np.ptp(stroke[:200]) > 0.0
    assert sessions.write_sessions(plans, tmp_path) is None, "what is there stays"


def test_a_sister_differs_within_its_tolerance_and_not_in_what_is_machined(bench):
    machine = load_machine("M22")
    other = bench[0].sister(machine, 0.03, np.random.default_rng(1))
    ratio = np.array(other.bodies.mass) / np.array(machine.bodies.mass)
    assert (np.abs(ratio - 1.0) <= 0.03).all()
    assert (ratio != 1.0).all()
    assert other.cylinders.bore == machine.cylinders.bore
    assert other.boom_cylinder == machine.boom_cylinder


def test_alarms_before_the_onset_are_false_and_delays_count_motion(bench):
    metrics = bench[1]
    moving = np.array([100] * 130 + [0] * 10 + [50] * 340)
    text = "internal_leak:arm:3.0L/min@120.0s"
    early = metrics.judged(text, moving, [60.0])
    assert (early.found, early.false_alarms, early.rank, early.healthy_s) == (False, 1, 1, 120.0)
    both = metrics.judged(text, moving, [120.0, 150.0])
    assert both.found
    assert both.false_alarms == 1
    assert both.delay_s == pytest.approx(10.0 + 0.5 * 10.0)
    assert metrics.share_found([early, both]) == 0.5
    assert metrics.median_delay([early, both]) == both.delay_s


def test_the_size_found_in_half_lies_between_sizes(bench):
    half = bench[1].size_found_in_half
    assert half({1.0: 0.0, 100.0: 1.0}) == pytest.approx(10.0)
    assert half({1.0: 0.6, 10.0: 0.4}) == 0.0
    assert half({1.0: 0.0, 10.0: 0.4}) == np.inf
    assert np.isnan(half({}))


def test_the_area_under_the_curve_counts_ties_half(bench):
    area = bench[1].area_under_curve
    assert area(np.array([0.0, 1.0]), np.array([2.0])) == 1.0
    assert area(np.array([1.0]), np.array([1.0, 0.0])) == 0.25


@pytest.mark.parametrize("name", ["PCA T2 + SPE", "linear residuals, k = 1 and 10"])
def test_rivals_see_a_gross_change_and_little_else(bench, name):
    rivals = bench[2]
    rng = np.random.default_rng(0)

    def session(length=6000):
        walk = np.cumsum(rng.normal(size=(length, 2)), axis=0)
        walk -= np.linspace(0.0, 1.0, length)[:, None] * walk[-1]
        return np.hstack([walk, walk @ [[1.0], [0.5]] + 0.1 * rng.normal(size=(length, 1))]).astype(np.float32)

    rival = rivals.rivals_of([])[name]
    rival.fit([session() for _ in range(8)], ticks=100)
    calm, faulty = session(), session()
    faulty[3000:, 2] += 60.0
    faulty[3000:, 2] += 20.0 * rng.normal(size=3000)
    chart = rivals.CHARTS["ewma"]
    limit = rivals.limit_of(chart, [rival.rows(session()) for _ in range(12)], 1.0, 0.05).limit
    found = rivals.raised(chart, limit, rival.rows(faulty), 1.0)
    assert any(when > 30.0 for when in found)
    assert len(rivals.raised(chart, limit, rival.rows(calm), 1.0)) <= 2
