"""Physics bases on poses drawn at random: streams, horizons, dimensions, equilibrium, arithmetic and graphs."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from edp.config.experiment import TaskSettings
from edp.networks.physics import PHYSICS, ForceSpec, HybridPhysicsSpec, KinematicSpec
from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import linkage, pose


def base_and_inputs(spec, horizons, seed, ticks=7):
    task = TaskSettings(horizons=horizons).resolve(100.0, physics=spec)
    base = spec.build(task).double()
    base.read()
    axes, plant = pack(load_machine(spec.machine))
    limits = pose.joint_limits(axes, plant)
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(1, ticks, len(task.inputs)))
    for name, column in base.columns.items():
        number = int(name[-1]) - 1
        if name.startswith("JointAngle"):
            x[..., column] = rng.uniform(*limits[number], ticks)
        if name.startswith("CylStroke"):
            x[..., column] = rng.uniform(0.0, axes[number, at.STROKE], ticks)
        if name.startswith("CylPressures"):
            x[..., column] = rng.uniform(0.0, 3e7, ticks)
    return base, torch.from_numpy(x)


def run(base, x, state=None):
    with torch.no_grad():
        return base(x, base.initial_state(1, x) if state is None else state)


SPECS = [
    KinematicSpec(pose="strokes"),
    ForceSpec(load="none", decay_s=0.0),
    ForceSpec(load="all", pose="strokes", decay_s=0.0),
    HybridPhysicsSpec(load="gravity", machine="C14", decay_s=0.0),
    HybridPhysicsSpec(coupled=True, decay_s=0.1),
]


@settings(max_examples=25, deadline=None)
@given(spec=st.sampled_from(SPECS), seed=st.integers(0, 10_000), cut=st.integers(1, 6))
def test_any_cut_gives_the_same_velocities(spec, seed, cut):
    base, x = base_and_inputs(spec, (1, 10), seed)
    whole, _ = run(base, x)
    first, state = run(base, x[:, :cut])
    second, _ = run(base, x[:, cut:], state)
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole, rtol=1e-12, atol=1e-12)
    assert torch.isfinite(whole).all()


@settings(max_examples=25, deadline=None)
@given(spec=st.sampled_from(SPECS[1:4]), seed=st.integers(0, 10_000), k=st.integers(2, 50))
def test_a_held_acceleration_grows_with_the_horizon_and_a_fading_one_stops(spec, seed, k):
    base, x = base_and_inputs(spec, (1, 2, k + 1), seed)
    z, _ = run(base, x)
    torch.testing.assert_close(z[:, :, 2] - z[:, :, 0], k * (z[:, :, 1] - z[:, :, 0]), rtol=1e-5, atol=1e-6)
    fading, _ = base_and_inputs(type(spec)(machine=spec.machine, load=spec.load, pose=spec.pose, decay_s=0.05), (k,), 0)
    assert 0.0 < fading.lasting()[0] < min(0.05, k * 0.01)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), by=st.floats(0.1, 10.0), kind=st.sampled_from(["force", "hybrid"]))
def test_dimensions(seed, by, kind):
    """Literal forms: twice the pressure, or half of all masses, is twice the change of velocity."""
    base, x = base_and_inputs(PHYSICS[kind](load="none"), (1, 2), seed)
    change = _change(base, x)
    pressures = [column for name, column in base.columns.items() if name.startswith("CylPressures")]
    more = x.clone()
    more[..., pressures] *= by
    torch.testing.assert_close(_change(base, more), by * change, rtol=1e-5, atol=1e-9)
    if kind == "hybrid":  # m and I scale together; lengths stay
        base.geometry.axes[:, 1] *= by
        base.geometry.axes[:, 4] *= by
        torch.testing.assert_close(_change(base, x), change / by, rtol=1e-5, atol=1e-9)


def _change(base, x):
    z, _ = run(base, x)
    return z[:, :, 1] - z[:, :, 0]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_machine_in_equilibrium_stays(seed):
    """Cylinders that carry the weight exactly do not accelerate, in any pose."""
    base, x = base_and_inputs(HybridPhysicsSpec(load="gravity"), (1, 10), seed, ticks=1)
    x[..., [base.columns[f"JointVel_{i + 1}"] for i in range(3)]] = 0.0
    with torch.no_grad():
        found = base.pose(x)
        force = (base.geometry.gravity_torque(found) / found.lever)[0, 0]
    head, rod = base.geometry.axis("HEAD_AREA"), base.geometry.axis("ROD_AREA")
    for i in range(3):
        x[..., base.columns[f"CylPressures_{i + 5}"]] = 5e6
        x[..., base.columns[f"CylPressures_{i + 1}"]] = (force[i] + rod[i] * 5e6) / head[i]
    torch.testing.assert_close(run(base, x)[0], torch.zeros(1, 1, 2, 3).double(), rtol=0, atol=1e-6)


def test_an_axis_at_rest_is_held_and_one_at_its_stop_too():
    base, x = base_and_inputs(HybridPhysicsSpec(), (10,), 4, ticks=1)
    axes, plant = pack(load_machine("M22"))
    x[..., [base.columns[f"JointVel_{i + 1}"] for i in range(3)]] = 0.0
    x[..., [base.columns[f"JointAngle_{i + 1}"] for i in range(3)]] = torch.tensor(
        [
            linkage.angle_at_stroke(i, share * axes[i, at.STROKE], axes, plant)
            for i, share in enumerate((0.5, 1.0, 0.5))
        ],
        dtype=torch.float64,
    )
    x[..., base.columns["CylPressures_2"]], x[..., base.columns["CylPressures_6"]] = 3e7, 0.0  # pressed outward
    weight = (base.geometry.gravity_torque(base.pose(x)) / base.pose(x).lever)[0, 0]
    for i in (0, 2):  # within static friction of equilibrium
        force = weight[i] + 0.5 * axes[i, at.STATIC]
        x[..., base.columns[f"CylPressures_{i + 1}"]] = force / axes[i, at.HEAD_AREA]
        x[..., base.columns[f"CylPressures_{i + 5}"]] = 0.0
    assert run(base, x)[0].abs().max() < 1e-9
    x[..., base.columns["CylPressures_2"]], x[..., base.columns["CylPressures_6"]] = 0.0, 3e7  # pulled off
    assert run(base, x)[0][0, 0, 0, 1] < -0.02


class Counter(TorchDispatchMode):
    """Counts numbers made by multiplications, divisions, roots, exponentials and sines."""

    NAMES = ("mul", "div", "sqrt", "square", "pow", "exp", "cos", "sin", "reciprocal")

    def __init__(self):
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        # What the machine's numbers alone give is computed once, in a build for a target.
        of_inputs = any(isinstance(a, torch.Tensor) and a.dim() > 1 for a in args)
        if of_inputs and func.__name__.split(".")[0] in self.NAMES:
            self.total += result.numel()
        return result


@pytest.mark.parametrize("pose_", ["angles", "strokes"])
@pytest.mark.parametrize(
    "options",
    [
        ("kinematic", {}),
        ("force", {"load": "none"}),
        ("force", {"load": "gravity"}),
        ("force", {"load": "all"}),
        ("hybrid", {"load": "none"}),
        ("hybrid", {"load": "all"}),
        ("hybrid", {"load": "all", "coupled": True}),
    ],
)
def test_operations_are_what_a_tick_computes(options, pose_):
    kind, further = options
    base, x = base_and_inputs(PHYSICS[kind](pose=pose_, **further), (1, 10), 0, ticks=1)
    with Counter() as counted:
        run(base, x)
    assert base.costs()[0].per_prediction == counted.total


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: f"{PHYSICS.name_of(spec)}-{spec.pose}")
def test_a_tick_is_one_graph_without_branches(spec):
    """What an export needs: every tick runs the same operations, and the traced graph gives the same bits."""
    base, x = base_and_inputs(spec, (1, 10), 5, ticks=1)
    state = base.initial_state(1, x)
    graph = torch.export.export(base, (x, state)).module()
    _, other = base_and_inputs(spec, (1, 10), 6, ticks=1)
    assert torch.equal(graph(other, state)[0], base(other, state)[0])
