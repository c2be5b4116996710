"""Rigid body and linkage against MuJoCo, which builds them from bodies, joints and sites rather than formulas."""

import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import newton

from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.parameters import pack
from edp.sim.physics import dynamics, linkage

RANGES = np.radians([(-47.0, 60.0), (-148.0, -30.0), (-138.0, 30.0)])


@pytest.fixture(scope="module", params=["M22", "C14"])
def machine(request):
    return load_machine(request.param)


@pytest.fixture(scope="module")
def packed(machine):
    return pack(machine)


def polar(radius, degrees):
    return f"{radius * math.cos(math.radians(degrees))} {radius * math.sin(math.radians(degrees))} 0"


def body(machine, i, inner, sites="", at_x=0.0):
    b = machine.bodies
    inertia = b.inertia[i]
    return f"""<body name="b{i}" pos="{at_x} 0 0"><joint name="j{i}" type="hinge" axis="0 0 1"/>
      <inertial pos="{b.com_x[i]} {b.com_y[i]} 0" mass="{b.mass[i]}" diaginertia="{inertia} {inertia} {inertia}"/>
      {sites}{inner}</body>"""


def front(machine, linkage_parts="", loop=""):
    boom, arm = machine.boom_cylinder, machine.arm_cylinder
    lug = machine.bucket_linkage
    tip = f'<site name="lug" pos="{polar(lug.lug, math.degrees(lug.lug_angle))}"/>'
    bucket = body(machine, 2, "", tip, machine.bodies.length[1])
    cylinder = f'<site name="bucket_base" pos="{lug.cylinder_pin[0]} {lug.cylinder_pin[1]} 0"/>'
    arm_sites = f'<site name="arm_rod" pos="{polar(arm.rod_radius, 150.0)}"/>{cylinder}{linkage_parts}'
    arm_body = body(machine, 1, bucket, arm_sites, machine.bodies.length[0])
    x, y = (arm.base_radius * f(math.radians(155.0)) for f in (math.cos, math.sin))
    base = f"{machine.bodies.length[0] + x} {y} 0"
    boom_sites = f'<site name="boom_rod" pos="{polar(boom.rod_radius, 26.0)}"/><site name="arm_base" pos="{base}"/>'
    boom_body = body(machine, 0, arm_body, boom_sites)
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/>
      <option gravity="0 -{machine.gravity} 0" timestep="1e-4" integrator="RK4"><flag contact="disable"/></option>
      <worldbody><site name="boom_base" pos="{polar(boom.base_radius, -43.0)}"/>{boom_body}</worldbody>
      <tendon><spatial name="t0"><site site="boom_base"/><site site="boom_rod"/></spatial>
      <spatial name="t1"><site site="arm_base"/><site site="arm_rod"/></spatial></tendon>
      <actuator><motor tendon="t0"/><motor tendon="t1"/></actuator>{loop}</mujoco>""")


def bucket_chain(machine):
    """A rocker body in the arm frame, to close the loop by Newton in `loop_length`."""
    b = machine.bucket_linkage
    x = machine.bodies.length[1] - b.pivot_to_pin
    return f"""<body name="rocker" pos="{x} {b.pivot_offset} 0"><joint name="jr" type="hinge" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-9 1e-9 1e-9"/><site name="pin" pos="{b.rocker} 0 0"/></body>"""


def loop_length(model, data, machine, psi3, guess):
    """Bucket cylinder length by Newton on the link's length, from MuJoCo's own kinematics."""

    def miss(rocker):
        data.joint("jr").qpos[0], data.joint("j2").qpos[0] = rocker, psi3
        mujoco.mj_kinematics(model, data)
        return np.linalg.norm(data.site("pin").xpos - data.site("lug").xpos) - machine.bucket_linkage.link

    root = newton(miss, guess, tol=1e-13)
    miss(root)
    return float(np.linalg.norm(data.site("pin").xpos - data.site("bucket_base").xpos)), root


def test_mass_matrix_and_bias(machine, packed):
    axes, plant = packed
    model = front(machine)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    for _ in range(200):
        psi, rate = rng.uniform(*RANGES.T), rng.uniform(-2, 2, 3)
        data.qpos[:], data.qvel[:] = psi, rate
        mujoco.mj_forward(model, data)
        expected, mass = np.zeros((3, 3)), np.zeros((3, 3))
        for column, unit in zip(expected, np.eye(3), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        dynamics.mass_matrix(psi, axes, mass)
        np.testing.assert_allclose(mass, expected, rtol=1e-10, atol=1e-10 * expected.max())
        bias = dynamics.bias_torque(psi, rate, axes, plant)
        np.testing.assert_allclose(bias, data.qfrc_bias, rtol=1e-10, atol=1e-10 * np.abs(data.qfrc_bias).max())


def test_cylinder_lengths_and_lever_arms(machine, packed):
    _, plant = packed
    model = front(machine, bucket_chain(machine))
    data = mujoco.MjData(model)
    names = [model.joint(i).name for i in range(model.njnt)]
    order = [names.index(f"j{i}") for i in range(3)]
    rocker = 2.2
    for share in np.linspace(0.0, 1.0, 25):
        psi = RANGES[:, 1] + share * (RANGES[:, 0] - RANGES[:, 1])
        data.qpos[order] = psi
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        for axis in range(2):
            length, _ = linkage.cylinder(axis, psi[axis], plant)
            assert length == pytest.approx(data.ten_length[axis], abs=1e-9)
        expected, rocker = loop_length(model, data, machine, psi[2], rocker)
        assert linkage.cylinder(2, psi[2], plant)[0] == pytest.approx(expected, abs=1e-9)
    for axis in range(3):
        for psi in np.linspace(*RANGES[axis], 40):
            ahead, behind = (linkage.cylinder(axis, psi + d, plant)[0] for d in (1e-6, -1e-6))
            assert linkage.cylinder(axis, psi, plant)[1] == pytest.approx((ahead - behind) / 2e-6, rel=1e-6)


@pytest.mark.parametrize("axis", range(3))
def test_lever_arm_keeps_its_sign_beyond_the_stops(axis, packed):
    _, plant = packed
    reach = np.linspace(RANGES[axis, 0] - math.radians(4), RANGES[axis, 1] + math.radians(4), 400)
    arms = np.array([linkage.cylinder(axis, psi, plant)[1] for psi in reach])
    assert len(set(np.sign(arms))) == 1
    assert np.abs(arms).min() > 0.1


def test_strokes_fit_the_joint_ranges(packed):
    axes, plant = packed
    for axis in range(3):
        ends = [linkage.angle_at_stroke(axis, share * axes[axis, at.STROKE], axes, plant) for share in (0.0, 1.0)]
        np.testing.assert_allclose(sorted(ends), RANGES[axis], atol=math.radians(1.0))


def test_forward_motion_under_constant_cylinder_forces(machine, packed):
    axes, plant = packed
    forces = np.array([320e3, -10e3, 5e3]) * axes[0, at.HEAD_AREA] / 0.02454  # bores of M22
    start = np.radians([10.0, -80.0, -50.0])
    model = front(machine)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    data.ctrl[:] = forces[:2]
    chain = front(machine, bucket_chain(machine))
    chain_data = mujoco.MjData(chain)
    # the bucket's lever arm by differences of the closed loop, tabulated beforehand
    grid, rocker, lengths = np.linspace(-2.4, 0.5, 300), 2.2, []
    for psi in grid[::-1]:
        length, rocker = loop_length(chain, chain_data, machine, psi, rocker)
        lengths.append(length)
    lever = CubicSpline(grid, lengths[::-1]).derivative()
    steps, step_s = 8000, model.opt.timestep
    for _ in range(steps):
        # held for a step: taken at its middle, which is of second order
        data.qfrc_applied[2] = forces[2] * lever(data.qpos[2] + 0.5 * step_s * data.qvel[2])
        mujoco.mj_step(model, data)

    def motion(_, y):
        mass = np.zeros((3, 3))
        dynamics.mass_matrix(y[:3], axes, mass)
        levers = np.array([linkage.cylinder(i, y[i], plant)[1] for i in range(3)])
        torque = levers * forces - dynamics.bias_torque(y[:3], y[3:], axes, plant)
        return np.concatenate((y[3:], np.linalg.solve(mass, torque)))

    ours = solve_ivp(motion, (0, steps * step_s), np.concatenate((start, np.zeros(3))), rtol=1e-10, atol=1e-12)
    assert np.ptp(ours.y[:3], axis=1).min() > 0.02
    np.testing.assert_allclose(ours.y[:3, -1], data.qpos, atol=1e-5)
