"""Physics bases against the simulator's truth, an independent NumPy form, and each other."""

from importlib import resources

import numpy as np
import pytest
import torch

from edp.config.experiment import TaskSettings
from edp.data.features import FG1
from edp.data.prepared import prepare
from edp.data.splits import ByRecording
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, DataError
from edp.evaluation.judge import JudgeSpec, judge
from edp.networks.physics import PHYSICS, ForceSpec, HybridPhysicsSpec, KinematicSpec
from edp.networks.physics.geometry import Geometry
from edp.networks.physics.hybrid import solve
from edp.networks.predictor import ModelSpec, build_model
from edp.sim import Scenario, load_machine, simulate
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import dynamics, friction, linkage, pose
from edp.sim.simulate import Simulation
from edp.training import Bundle, load_bundle, save_bundle
from edp.training.bundle import blank_scaler

MACHINES = ("M22", "C14", "family-3-1", "family-8-5")
SECONDS = 40.0


@pytest.fixture(scope="module")
def truth():
    """A noise-free recording of M22 and the plant's log behind it."""
    simulation = Simulation(Scenario(machine="M22", duration_s=SECONDS, seed=1, sensor_noise=False))
    log = simulation.run(simulation.scenario.samples)
    return simulation.recording(), log


@pytest.fixture(scope="module")
def noisy():
    return simulate(Scenario(machine="M22", duration_s=SECONDS, seed=1))


def predicted(spec, recording, horizons=(1,)):
    """What a base alone says, ``(time, horizon, 3)``, and the task."""
    task = TaskSettings(horizons=horizons, mode="absolute").resolve(100.0, physics=spec)
    base = spec.build(task).double()
    base.read()
    x = torch.from_numpy(task.series(recording).inputs)[None].double()
    base.settle([x[0]])
    return base(x, base.initial_state(1, x))[0][0].numpy(), task


def reference(log, load, mass=None):
    """Velocity and acceleration of each cylinder from the simulator's own linkage and dynamics, row by row."""
    axes, plant = pack(load_machine("M22"))
    rows = []
    for row in log:
        psi, rate, v = (row[i : i + 3] for i in (at.PSI, at.RATE, at.LOG_VELOCITY))
        lever = np.array([linkage.cylinder(i, psi[i], plant)[1] for i in range(3)])
        force = axes[:, at.HEAD_AREA] * row[at.HEAD : at.HEAD + 3] - axes[:, at.ROD_AREA] * row[at.ROD : at.ROD + 3]
        inertia, weight = np.empty((3, 3)), np.empty(3)
        dynamics.mass_matrix(psi, axes, inertia)
        dynamics.gravity_torque(psi, axes, plant[at.GRAVITY], weight)
        if load == "gravity":
            force = force - weight / lever
        if load == "all":
            force = force - dynamics.bias_torque(psi, rate, axes, plant) / lever
            share = np.exp(-((v / axes[:, at.STRIBECK]) ** 2))
            stroke = row[at.LOG_STROKE : at.LOG_STROKE + 3]
            blocked = (stroke < 3e-3) & (force < 0) | (stroke > axes[:, at.STROKE] - 3e-3) & (force > 0)
            held = share * np.clip(force, -axes[:, at.STATIC], axes[:, at.STATIC])
            sliding = (1 - share) * np.sign(v) * axes[:, at.COULOMB] + axes[:, at.VISCOUS] * v
            force = np.where(blocked, 0.0, force - held - sliding)
        own = np.diag(inertia) / lever**2
        rows.append((lever * rate, force, own))
    speed, force, own = (np.array(part) for part in zip(*rows, strict=True))
    return speed, force / (own.mean(axis=0) if mass == "mean" else own)


@pytest.mark.parametrize("machine", MACHINES)
def test_levers_and_lengths_are_those_of_the_simulator_from_angles_and_from_strokes(machine):
    axes, plant = pack(load_machine(machine))
    geometry = Geometry().double()
    geometry.read(machine)
    kinematics = pose.Kinematics(axes, plant)
    shares = np.random.default_rng(0).uniform(0.0, 1.0, (60, 3))
    shares[:2] = [[0, 0, 0], [1, 1, 1]]
    angles = np.array([kinematics.angles_at(row) for row in shares])
    truth = np.array([[linkage.cylinder(i, row[i], plant) for i in range(3)] for row in angles])
    from_angles = geometry.compute_pose_at_angles(torch.from_numpy(angles))
    from_strokes = geometry.compute_pose_at_strokes(torch.from_numpy(shares * axes[:, at.STROKE]))
    for found in (from_angles, from_strokes):
        np.testing.assert_allclose(found.length.numpy(), truth[..., 0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.lever.numpy(), truth[..., 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(torch.atan2(found.sine, found.cosine).numpy(), _wrapped(angles), rtol=0, atol=1e-8)


def _wrapped(angles):
    return np.arctan2(np.sin(angles), np.cos(angles))


@pytest.mark.parametrize("machine", MACHINES)
def test_masses_and_torques_are_those_of_the_simulator(machine):
    axes, plant = pack(load_machine(machine))
    geometry = Geometry().double()
    geometry.read(machine)
    rng = np.random.default_rng(1)
    limits = pose.joint_limits(axes, plant)
    angles, rates = rng.uniform(limits[:, 0], limits[:, 1], (30, 3)), rng.normal(size=(30, 3))
    found = geometry.compute_pose_at_angles(torch.from_numpy(angles))
    by_cosine, by_sine = geometry.couplings(found)
    own, coupling = geometry.masses(by_cosine)
    bias = geometry.gravity_torque(found) + geometry.coriolis_torque(by_sine, torch.from_numpy(rates))
    inertia = np.empty((3, 3))
    for k in range(30):
        dynamics.mass_matrix(angles[k], axes, inertia)
        np.testing.assert_allclose(own[k].numpy(), np.diag(inertia), rtol=1e-6)
        np.testing.assert_allclose(coupling[k].numpy(), inertia[[0, 0, 1], [1, 2, 2]], rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(
            bias[k].numpy(), dynamics.bias_torque(angles[k], rates[k], axes, plant), rtol=1e-5, atol=0.5
        )
    step = 1e-5
    levers = [
        np.array([[linkage.cylinder(i, row[i] + side, plant)[1] for i in range(3)] for row in angles])
        for side in (step, -step)
    ]
    np.testing.assert_allclose(
        geometry.lever_change(found).numpy(), (levers[0] - levers[1]) / (2 * step), rtol=2e-3, atol=2e-3
    )


def test_the_kinematic_base_is_the_measured_velocity_to_sensor_noise(truth, noisy):
    found, task = predicted(KinematicSpec(), noisy, (1, 10))
    error = found[:, 0] - task.series(noisy).targets
    sensor = load_machine("M22").sensors.velocity
    np.testing.assert_allclose(error.std(axis=0), sensor, rtol=0.05)
    assert np.abs(error.mean(axis=0)).max() < 4 * sensor / np.sqrt(len(error))
    np.testing.assert_array_equal(found[:, 0], found[:, 1])
    exact, _ = predicted(KinematicSpec(), truth[0])
    np.testing.assert_allclose(exact[:, 0], truth[1][:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3], rtol=0, atol=1e-6)


def test_strokes_give_the_mean_velocity_since_the_tick_before(truth):
    found, _ = predicted(KinematicSpec(pose="strokes"), truth[0])
    velocity = truth[1][:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    middle = 0.5 * (velocity[1:] + velocity[:-1])
    assert np.array_equal(found[0, 0], np.zeros(3))
    # The mean of the ends is not the mean of the way between them, and strokes in single precision resolve 0.1 um.
    error = np.sqrt(np.mean((found[1:, 0] - middle) ** 2, axis=0))
    assert (error < 0.1 * np.sqrt(np.mean(np.diff(velocity, axis=0) ** 2, axis=0))).all()


@pytest.mark.parametrize("load", ["none", "gravity", "all"])
def test_force_and_hybrid_are_eq_3_8_and_3_9_with_the_stated_load(truth, load):
    recording, log = truth
    for spec, mass in ((ForceSpec(load=load, decay_s=0.0), "mean"), (HybridPhysicsSpec(load=load, decay_s=0.0), None)):
        found, _ = predicted(spec, recording, (1, 7))
        speed, acceleration = reference(log, load, mass)
        for i, k in enumerate((1, 7)):
            wanted = speed + acceleration * k * 0.01
            scale = np.abs(acceleration).max() * 0.07
            np.testing.assert_allclose(found[:, i], wanted, rtol=0, atol=1e-4 * scale)


def test_the_load_decides_whether_a_force_tells_the_change_of_velocity(truth):
    """Over one step of 10 ms, against the true change: rms error as a share of the change's own rms."""
    recording, log = truth
    velocity = log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    change = np.sqrt(np.mean(np.diff(velocity, axis=0) ** 2, axis=0))

    def share(spec):
        found, _ = predicted(spec, recording)
        return np.sqrt(np.mean((found[:-1, 0] - velocity[1:]) ** 2, axis=0)) / change

    literal, gravity, whole = (share(HybridPhysicsSpec(load=load, decay_s=0.0)) for load in ("none", "gravity", "all"))
    coupled = share(HybridPhysicsSpec(coupled=True, decay_s=0.0))
    assert (literal > 1.2).all()  # worse than no change at all: gravity alone moves the boom
    assert literal[0] > 2.0
    assert gravity[0] < 0.5
    assert whole[0] < 0.5
    assert (whole <= gravity * 1.05).all()
    assert (coupled[:2] < whole[:2]).all()
    assert coupled[0] < 0.3


def test_the_equation_of_motion_is_the_simulators(truth):
    """With the true bristle friction, which no sensor shows, the coupled equation gives the acceleration itself."""
    _, log = truth
    axes, _ = pack(load_machine("M22"))
    geometry = Geometry().double()
    geometry.read("M22")
    row = torch.from_numpy(log)
    found, rate = geometry.compute_pose_at_angles(row[:, at.PSI : at.PSI + 3]), row[:, at.RATE : at.RATE + 3]
    drag = np.array(
        [
            [
                friction.lugre(r[at.LOG_VELOCITY + i], r[at.BRISTLE + i], axes, i, axes[i, at.VISCOUS])[0]
                - friction.end_stop(r[at.LOG_STROKE + i], r[at.LOG_VELOCITY + i], axes, i)[0]
                for i in range(3)
            ]
            for r in log
        ]
    )
    force = geometry.axis("HEAD_AREA") * row[:, at.HEAD : at.HEAD + 3]
    force = force - geometry.axis("ROD_AREA") * row[:, at.ROD : at.ROD + 3] - torch.from_numpy(drag)
    by_cosine, by_sine = geometry.couplings(found)
    torque = force * found.lever - geometry.gravity_torque(found) - geometry.coriolis_torque(by_sine, rate)
    turned = solve(*geometry.masses(by_cosine), torque)
    acceleration = (found.lever * turned + geometry.lever_change(found) * rate.square()).numpy()
    velocity = log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]
    change = np.diff(velocity, axis=0)
    # The mean of both ends: a force that changes within the step counts as a line.
    error = 0.005 * (acceleration[1:] + acceleration[:-1]) - change
    share = np.sqrt(np.mean(error**2, axis=0) / np.mean(change**2, axis=0))
    assert share.max() < 0.2
    for i in range(3):
        assert np.corrcoef(acceleration[:-1, i], change[:, i])[0, 1] > 0.95


@pytest.mark.parametrize("mode", list(TargetMode))
@pytest.mark.parametrize("kind", list(PHYSICS))
def test_a_network_that_says_nothing_predicts_what_its_base_says(mode, kind, truth):
    spec = PHYSICS[kind]()
    settings_ = TaskSettings(horizons=(1, 10), mode=mode, targets=("CylVels_2", "CylPressures_1", "CylVels_1"))
    task = settings_.resolve(100.0, physics=spec)
    predictor = build_model(task, ModelSpec(physics=spec), blank_scaler(task), seed=0).double()
    with torch.no_grad():
        predictor.code.width.uniform_(0.1, 2.0)
        predictor.code.offset.uniform_(0.0, 0.0 if mode == "delta" else 1.0)
        for parameter in (predictor.heads.weights[-1], predictor.heads.biases[-1]):
            parameter.zero_()
        x = torch.from_numpy(task.series(truth[0]).inputs)[None, :300].double()
        physical, _ = predictor.predict(x, predictor.initial_state(1, x))
        z, _ = predictor.physics(x, predictor.physics.initial_state(1, x))
    torch.testing.assert_close(physical[..., [0, 2]], z[..., [0, 2]], rtol=0, atol=1e-9)
    pressure = x[..., [6]] if mode == "delta" else predictor.code.offset[:, 1].expand(1, 300, 2)
    torch.testing.assert_close(physical[..., 1], pressure.expand(1, 300, 2), rtol=1e-9, atol=1e-9)


def test_missing_channels_are_named_at_once(truth):
    recording = truth[0]
    fewer = [i for i, name in enumerate(recording.channel_names) if not name.startswith("Joint")]
    bare = type(recording)(
        "bare", tuple(recording.channels[i] for i in fewer), recording.values[:, fewer], 100.0, "test"
    )
    task = TaskSettings().resolve(100.0, physics=ForceSpec(machine="C14"))
    with pytest.raises(DataError, match=r"bare.*lacks JointAngle_1, .*JointVel_3, which the physics base reads.*pose"):
        task.series(bare)


def test_a_channel_is_read_once():
    with pytest.raises(ConfigError, match="CylVels_1, which is read already"):
        Task(FG1, ("CylVels_1",), (1,), TargetMode.DELTA, 100.0, physics=("CylVels_1",))


def test_an_unknown_machine_is_refused_with_the_closest(tmp_path):
    task = TaskSettings().resolve(100.0, physics=KinematicSpec(machine="M23"))
    with pytest.raises(ConfigError, match=r"unknown machine 'M23'.*M22"):
        build_model(task, ModelSpec(physics=KinematicSpec(machine="M23")), blank_scaler(task), seed=0)


def test_a_bundle_opens_without_the_machine_file(tmp_path, truth, monkeypatch):
    """The file is gone and reading any machine fails: the numbers are in the weights."""
    file = tmp_path / "own.toml"
    text = resources.files("edp.sim").joinpath("machines").joinpath("c14.toml").read_text(encoding="utf-8")
    file.write_text(text, encoding="utf-8")
    spec = ForceSpec(machine=str(file))
    task = TaskSettings(horizons=(5,)).resolve(100.0, physics=spec)
    data = prepare([truth[0].rows(0, 2000, "a"), truth[0].rows(2000, 4000, "b")], task, ByRecording(test=("b",)), 10)
    predictor = build_model(task, ModelSpec(physics=spec), data.scaler(), seed=0).eval()
    predictor.physics.settle([torch.from_numpy(part.inputs) for part in data.train])
    save_bundle(Bundle(predictor, data.inputs, data.target_kinds, data.descriptions), tmp_path / "bundle")
    file.unlink()
    monkeypatch.setattr(Geometry, "read", lambda self, machine: pytest.fail(f"read {machine}"))
    loaded = load_bundle(tmp_path / "bundle")
    assert [channel.name for channel in loaded.inputs[24:]] == list(task.physics)
    x = torch.from_numpy(data.test[0].inputs)[None, :50]
    with torch.no_grad():
        found, wanted = (net.predict(x, net.initial_state(1, x))[0] for net in (loaded.predictor, predictor))
    assert torch.equal(found, wanted)


def test_baselines_do_not_see_the_physics_columns(truth):
    recordings = [truth[0].rows(0, 2000, "a"), truth[0].rows(2000, 4000, "b")]
    split = ByRecording(test=("b",))
    scores = []
    for spec in (None, KinematicSpec()):
        task = TaskSettings(horizons=(5,)).resolve(100.0, physics=spec)
        data = prepare(recordings, task, split, 10)
        predictor = build_model(task, ModelSpec(physics=spec, window=10), data.scaler(), seed=0).eval()
        found = judge(predictor, data, JudgeSpec(baselines=("persistence", "ridge_arx"), history=10), "network")
        scores.append({name: found.scores.models[name].overall for name in ("persistence", "ridge_arx")})
    assert scores[0] == scores[1]
