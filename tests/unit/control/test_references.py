"""References and tasks: time laws, what can be reached, and what each task promises of its path."""

import numpy as np
import pytest

from edp.control.geometry import TipGeometry
from edp.control.limits import LoopLimits
from edp.control.reference import check_speeds, reference_of_strokes, reference_of_tip
from edp.control.tasks import TASKS, draw_task
from edp.control.tasks.time_law import LAWS, progress, timed
from edp.errors import ConfigError
from edp.sim.machine.machine_files import load_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics.pose import Kinematics

RATE = 100.0


@pytest.fixture(scope="module")
def geometry():
    return TipGeometry(load_machine("M22"))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("length", [0.4, 5.0])
def test_a_time_law_goes_from_rest_to_rest_without_a_step_in_speed(law, length):
    time = np.linspace(-0.5, length + 0.5, 4001)
    done = progress(time, length, 0.5, law)
    assert (done[time <= 0.0] == 0.0).all()
    assert done[time >= length] == pytest.approx(1.0)
    speed = np.gradient(done, time)
    assert speed.min() > -1e-9
    # The top speed of a way with ramps: the length less one ramp.
    assert speed.max() == pytest.approx(1.0 / (length - min(0.5, 0.5 * length)), rel=1e-3)
    assert np.abs(np.diff(speed)).max() < 0.01 * speed.max()


def test_legs_are_run_one_after_another_and_rests_lie_around_them():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    rows, judged = timed(points, [2.0, 4.0], 10.0, 0.5, "trapezoid", 1.0, 0.5)
    assert len(rows) == 76
    assert judged.tolist() == [False] * 10 + [True] * 66
    assert rows[10] == pytest.approx([0.0, 0.0])
    # Half of a leg at half of its time, and the corner after the first leg.
    assert rows[20] == pytest.approx([0.5, 0.0])
    assert rows[30] == pytest.approx([1.0, 0.0])
    assert rows[-1] == pytest.approx([1.0, 2.0])


def test_tip_and_strokes_are_inverse_and_those_of_the_simulators_kinematics(geometry):
    shares = np.random.default_rng(0).uniform(0.1, 0.9, (20, 3))
    poses = geometry.tip(shares * geometry.full_m)
    strokes, reachable = geometry.strokes(poses)
    assert reachable.all()
    assert strokes == pytest.approx(shares * geometry.full_m, abs=1e-9)
    kinematics = Kinematics(*pack(geometry.machine))
    assert poses[3] == pytest.approx(kinematics.pose_at(shares[3]), abs=1e-9)
    assert geometry.tip(shares[:4].reshape(2, 2, 3) * geometry.full_m).shape == (2, 2, 3)


def test_a_pose_out_of_reach_is_named_with_its_time(geometry):
    poses = np.repeat(geometry.tip(0.5 * geometry.full_m)[None], 300, axis=0)
    poses[120:, 0] += 30.0
    with pytest.raises(ConfigError, match=r"reference 'mine': the M22 cannot reach x = 3\d\.\d+ m.*t = 1\.20 s"):
        reference_of_tip("mine", poses, geometry, RATE)


def test_a_stroke_beyond_its_margin_is_named_with_its_time(geometry):
    strokes = np.repeat(0.5 * geometry.full_m[None], 200, axis=0)
    strokes[50:, 1] = 0.97 * geometry.full_m[1]
    reference_of_strokes("mine", strokes, geometry, RATE)
    with pytest.raises(ConfigError, match=r"arm cylinder of the M22 would be at 97\.0% of its stroke at t = 0\.50 s"):
        reference_of_strokes("mine", strokes, geometry, RATE, margin=0.04)


def test_a_speed_that_the_machine_lacks_is_named(geometry):
    strokes = np.repeat(0.5 * geometry.full_m[None], 200, axis=0)
    strokes[:, 2] += np.linspace(0.0, -0.2, 200)
    reference = reference_of_strokes("mine", strokes, geometry, RATE)
    check_speeds("mine", reference, geometry, np.full((2, 3), 0.11))
    with pytest.raises(ConfigError, match=r"bucket cylinder.*-0\.101 m/s.*1\.01 times as fast as it can"):
        check_speeds("mine", reference, geometry, np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 0.1]]))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("machine", ["M22", "C14"])
def test_every_task_is_drawn_from_its_seed_and_can_be_reached(name, machine):
    front = TipGeometry(load_machine(machine))
    spec = TASKS[name]()
    first, again, other = (draw_task(spec, front, RATE, seed) for seed in (3, 3, 4))
    assert np.array_equal(first.reference.tip, again.reference.tip)
    assert not np.array_equal(first.reference.tip[0], other.reference.tip[0])
    reference = first.reference
    shares = reference.strokes / front.full_m
    assert shares.min() >= spec.margin - 1e-9
    assert shares.max() <= 1.0 - spec.margin + 1e-9
    assert front.tip(reference.strokes) == pytest.approx(reference.tip, abs=1e-6)
    assert reference.judged[-1]
    assert not reference.judged[0]
    assert first.material == spec.material


def test_a_graded_line_is_straight_has_its_slope_speed_and_attitude(geometry):
    spec = TASKS["grade"](slope_deg=45.0, speed_m_s=0.3, direction="outwards", length_m=(1.0, 1.2))
    tip = draw_task(spec, geometry, RATE, 5).reference.tip
    along = tip[-1] - tip[0]
    assert along[0] > 0.0
    assert along[1] == pytest.approx(along[0])
    assert 1.0 <= np.hypot(*along[:2]) <= 1.2
    assert np.abs((tip - tip[0]) @ np.array([1.0, -1.0, 0.0])).max() < 1e-9
    assert np.ptp(tip[:, 2]) < 1e-12
    assert np.hypot(*np.diff(tip[:, :2], axis=0).T).max() * RATE == pytest.approx(0.3, rel=1e-3)


def test_a_level_bucket_keeps_its_attitude_while_boom_and_arm_move(geometry):
    reference = draw_task(TASKS["level"](), geometry, RATE, 1).reference
    assert np.ptp(reference.tip[:, 2]) < 1e-9
    assert (np.ptp(reference.strokes, axis=0) > 0.01).all()


def test_corners_are_reached_at_rest(geometry):
    reference = draw_task(TASKS["corners"](width_m=1.0, height_m=0.5, legs=2), geometry, RATE, 2).reference
    speed = np.hypot(*np.gradient(reference.tip[:, :2], axis=0).T) * RATE
    corner = reference.tip[0, :2] + [reference.tip[-1, 0] - reference.tip[0, 0], 0.0]
    at = np.argmin(np.hypot(*(reference.tip[:, :2] - corner).T))
    assert speed[at] < 0.02
    assert np.abs(reference.tip[-1, :2] - reference.tip[0, :2]) == pytest.approx([1.0, 0.5])


def test_a_digging_cycle_goes_below_ground_and_ends_above_it(geometry):
    task = draw_task(TASKS["dig"](depth_m=(0.1, 0.1)), geometry, RATE, 0)
    assert task.reference.tip[:, 1].min() == pytest.approx(geometry.ground_m - 0.1)
    assert task.reference.tip[-1, 1] > geometry.ground_m
    assert task.material == "sandy_loam"


def test_a_task_that_no_draw_can_do_is_one_error_that_says_where(geometry):
    words = r"none of 200 draws can be done \(200 leave reach or strokes, 0 are too fast .*\): .*; the last: .* at t = "
    with pytest.raises(ConfigError, match=rf"task 'grade', seed 0: {words}"):
        draw_task(TASKS["grade"](length_m=(20.0, 25.0)), geometry, RATE, 0)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("grade", {"speed_m_s": 0.0}, "speed_m_s = 0.0; 0 < speed_m_s <= 10 must hold"),
        ("grade", {"law": "s_curv"}, "did you mean 's_curve'"),
        ("grade", {"direction": "inward"}, "did you mean 'inwards'"),
        ("grade", {"length_m": (2.0, 1.0)}, "the smaller number first"),
        ("corners", {"legs": 5}, "legs = 5"),
        ("point", {"points": 0}, "points = 0"),
        ("dig", {"depth_m": (0.2, 0.1)}, "the smaller number first"),
    ],
)
def test_options_out_of_range_are_refused(name, options, message):
    with pytest.raises(ConfigError, match=message):
        TASKS[name](**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lever_low": (-1.0, 0.0, -1.0), "lever_high": (1.0, 0.0, 1.0)}, "arm are both 0, so that it cannot move"),
        ({"lever_low": (0.1, 0.0, 0.0)}, "lever_low"),
        ({"slew_per_s": (0.0, 1.0, 1.0)}, "slew_per_s"),
        ({"slew_per_s": (1.0, 1.0)}, "lists 2; boom, arm and bucket must hold"),
        ({"stroke_margin": 0.5}, "stroke_margin"),
        ({"pressure_pa": float("nan")}, "pressure_pa"),
    ],
)
def test_limits_that_contradict_one_another_are_refused_before_the_start(options, message):
    with pytest.raises(ConfigError, match=message):
        LoopLimits(**options)
