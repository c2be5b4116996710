"""Soil forces on the bucket: cutting, edge, heel and compliant chassis. Module `terrain` moves the soil.

Cutting follows the earthmoving equation of Reece and McKyes, heel contact Bekker's pressure-sinkage law with elastic
unloading and Janosi's shear. Where soil keeps what the heel has pressed (`compaction`), repeated loading follows Wong
(Terramechanics and Off-Road Vehicle Engineering, repetitive loading): along a place's own unloading line up to the
sinkage that it has borne, along Bekker's curve beyond. Every force that depends on velocity opposes it or stands across
it, so that soil never gives energy; directions are regularised over `CREEP`. The front's frame is the boom foot:
x forward, y up.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics import bucket_back
from edp.sim.physics.ground_profile import DEEPEST, GRAVITY, press, rut_depth
from edp.sim.physics.ground_profile import SPACING as SPACING
from edp.sim.physics.ground_profile import height_at as height_at
from edp.sim.physics.jit import compiled, inlined
from edp.sim.physics.material import Material
from edp.sim.sensors import filters

Array = NDArray[np.float64]
Ground = tuple[Array, ...]
Four = tuple[float, float, float, float]
# numbers[...]: soil and bucket
(
    ACTIVE, WIDTH, DENSITY, SWELL, COHESION, ADHESION, BEKKER, EXPONENT, SHEAR_LENGTH, CONE, STEEPEST, REPOSE,
    ROUGHNESS, COURSE_STEP, SAWTOOTH, CAPACITY, FLOOR_COS, FLOOR_SIN, FLOOR_LENGTH, EDGE_AREA, LOAD_X, LOAD_Y,
    BUCKET_MASS, BUCKET_X, BUCKET_Y, BUCKET_INERTIA, PITCH_INERTIA, PITCH_STIFFNESS, PITCH_DAMPING, LIFT_MOMENT,
    UNLOADING, HEEL_DAMPING, HEAP_LIMIT, BEARING_LIMIT, METAL_COS, METAL_SIN, COMPACTION, BACK,
) = range(38)  # fmt: skip
NUMBERS = BACK + bucket_back.VALUES
# contact[...]: what one step needs; Jacobians of tip and heel hold one value per joint
(ON, DRAG, ACROSS, EDGE, EDGE_X, EDGE_Y, NORMAL, NORMAL_DAMPING, SLIDE, DEPTH, HEEL_DEPTH) = range(11)
TIP_JX, TIP_JY, HEEL_JX, HEEL_JY, PITCHED, POINTS, DAMPING, PUSH_DEPTH = 11, 14, 17, 20, 23, 27, 31, 40
CONTACTS = 41
CREEP = 0.02
"""Speed (m/s) over which the direction of soil forces is smoothed."""
STONE_STEP = 0.005
"""Travel per cell of the array of stone forces, m."""
COURSE = 8192
"""Number of cells of the periodic array of soil resistance. The stones repeat after 41 m of travel in soil."""
MIN_RAKE, MAX_RAKE = 10, 120
"""Rake angles (degrees) to which the table of cutting factors is limited."""
MIN_LEAN, MAX_LEAN = 0.17, 2.1
"""Rake angles (rad) within which the direction of the cutting force follows the rake."""
EDGE_DEPTH = 0.05
"""Depth at which the whole edge is in the ground, m."""
HEEL_CONTACT = 0.2
"""Length of the floor plate in contact with the ground, m; E."""
PIN_STIFFNESS = 1.2e7
"""Stiffness of the front attachment that supports the heel, N/m; E."""
TURNING = 0.05
"""Horizontal speed (m/s) over which the soil ahead of the edge changes from one side to the other."""
PUSHED_BACK = 0.5
"""Fraction of the cutting force on the bucket's back while the back does not move soil (`back_push` is 0); E."""


def cutting_factors(rake_deg: float, friction_deg: float, metal_deg: float) -> tuple[float, float, float]:
    """Return the n_gamma, N_c and N_a of the earthmoving equation at the failure angle that minimises N_gamma."""
    # Steps of 0.1 deg: the minimum over the failure angle is flat.
    failure = np.radians(np.linspace(5.0, 85.0, 801))
    rake, phi, delta = (math.radians(a) for a in (rake_deg, friction_deg, metal_deg))
    cot_out = 1.0 / np.tan(failure + phi)
    below = math.cos(rake + delta) + math.sin(rake + delta) * cot_out
    wedge = 1.0 / math.tan(rake) + 1.0 / np.tan(failure)
    # Where the denominator is not positive, no wedge can form; such failure angles are left out.
    weight = np.where((below > 1e-2) & (wedge > 0.0), wedge / (2.0 * np.maximum(below, 1e-2)), np.inf)
    n = int(np.argmin(weight))
    cohesion = (1.0 + cot_out[n] / math.tan(failure[n])) / below[n]
    adhesion = (1.0 - cot_out[n] / math.tan(rake)) / below[n]
    return float(weight[n]), float(cohesion), max(float(adhesion), 0.0)


@cache
def cutting_table(material: Material) -> Array:
    """Return `cutting_factors` for every degree of rake, shape (181, 3); constant where no wedge of soil can form.

    Shared by all grounds of a material: not to be changed.
    """
    # a wedge needs rake + failure angle + both frictions below 180 degrees
    most = min(MAX_RAKE, 160.0 - material.friction_deg - material.metal_friction_deg)
    angles = np.clip(np.arange(181), MIN_RAKE, most)
    return np.array([cutting_factors(a, material.friction_deg, material.metal_friction_deg) for a in angles])


def draw_course(material: Material, rng: np.random.Generator) -> Array:
    """Return the variation of the resistance, shape (COURSE, 3), periodic.

    Columns: a unit Ornstein-Uhlenbeck process over travelled distance; force (N) of stones, half-sines of 20-80 mm
    and 5-40 kN; strength of each dig, within 30 % of the mean.
    """
    course = np.zeros((COURSE, 3))
    # Eight cells a correlation length, see COURSE_STEP.
    keep = math.exp(-1.0 / 8.0)
    shocks = rng.normal(0.0, math.sqrt(1.0 - keep * keep), (COURSE, 1))
    # The first value comes from the stationary distribution, so the process has no transient.
    shocks[0] /= math.sqrt(1.0 - keep * keep)
    course[:, 0] = filters.lfilter(np.array([1.0, 0.0, 0.0, -keep, 0.0]), shocks)[:, 0]
    for _ in range(rng.poisson(material.stones_per_m * STONE_STEP * COURSE)):
        length = max(2, round(rng.uniform(0.02, 0.08) / STONE_STEP))
        where = (int(rng.integers(COURSE)) + np.arange(length)) % COURSE
        course[where, 1] += rng.uniform(5e3, 40e3) * np.sin(np.pi * (np.arange(length) + 0.5) / length)
    course[:, 2] = rng.uniform(0.7, 1.3, COURSE)
    return course


def pack_soil(material: Material, machine: Machine, cone_index: float) -> Array:
    """Return soil, bucket and chassis parameters for the compiled code."""
    bucket, chassis, bodies = machine.bucket, machine.chassis, machine.bodies
    loose = material.density / material.swell
    floor = math.radians(bucket.floor_angle_deg)
    repose = math.tan(math.radians(material.repose_deg))
    bekker = material.bekker_cohesive / bucket.width + material.bekker_frictional
    bearing = bekker * bucket.width * HEEL_CONTACT
    # E: unloads five times as stiffly as it loads to 5 cm, and no stiffer than steel plates and pins
    unloading = min(5.0 * bearing * 0.05 ** (material.bekker_exponent - 1.0), PIN_STIFFNESS)
    # Files give the frequency of rocking, which can be observed, instead of the stiffness.
    stiffness = chassis.pitch_inertia * (2.0 * math.pi * chassis.pitch_frequency) ** 2
    heap_area = 0.5 * 0.4**2 / repose  # E: heaps before the edge stay below 0.4 m
    values = {
        ACTIVE: 1.0,
        WIDTH: bucket.width,
        DENSITY: material.density,
        SWELL: material.swell,
        COHESION: material.cohesion,
        ADHESION: material.adhesion,
        METAL_COS: math.cos(math.radians(material.metal_friction_deg)),
        METAL_SIN: math.sin(math.radians(material.metal_friction_deg)),
        BEKKER: bearing,
        EXPONENT: material.bekker_exponent,
        SHEAR_LENGTH: material.shear_length,
        CONE: cone_index,
        STEEPEST: repose + material.cohesion / (material.density * GRAVITY * 0.5),
        REPOSE: repose,
        ROUGHNESS: material.roughness,
        COURSE_STEP: material.roughness_length / 8.0,
        SAWTOOTH: material.sawtooth,
        CAPACITY: bucket.capacity * loose,
        FLOOR_COS: math.cos(floor),
        FLOOR_SIN: math.sin(floor),
        FLOOR_LENGTH: bucket.floor_length,
        EDGE_AREA: bucket.edge_area,
        LOAD_X: bucket.load_x,
        LOAD_Y: bucket.load_y,
        BUCKET_MASS: bodies.mass[2],
        BUCKET_X: bodies.com_x[2],
        BUCKET_Y: bodies.com_y[2],
        BUCKET_INERTIA: bodies.inertia[2],
        PITCH_INERTIA: chassis.pitch_inertia,
        PITCH_STIFFNESS: stiffness,
        PITCH_DAMPING: 2.0 * chassis.pitch_damping * math.sqrt(stiffness * chassis.pitch_inertia),
        LIFT_MOMENT: chassis.lift_moment,
        UNLOADING: unloading,
        # 2 zeta sqrt(k m) with a tenth of critical damping, for twice the mass of the bucket.
        HEEL_DAMPING: 0.2 * math.sqrt(unloading * 2.0 * bodies.mass[2]),
        HEAP_LIMIT: heap_area * bucket.width * loose,
        COMPACTION: material.compaction,
        BEARING_LIMIT: 0.25 * cone_index * bucket.width * HEEL_CONTACT,  # E: bearing capacity, a quarter of the cone's
    }
    numbers = np.zeros(NUMBERS)
    numbers[list(values)] = list(values.values())
    numbers[BACK:] = bucket_back.pack(material, bucket.width)
    return numbers


@compiled
def cutting_force(depth: float, rake: float, surcharge: float, numbers: Array, table: Array) -> float:
    """Force (N) of the earthmoving equation at a depth (m), a rake (rad) and a surcharge (Pa)."""
    rake_deg = min(max(rake * 57.29577951308232, MIN_RAKE), MAX_RAKE - 1e-9)
    k = int(rake_deg)
    part = rake_deg - k
    weight = table[k, 0] + part * (table[k + 1, 0] - table[k, 0])
    cohesion = table[k, 1] + part * (table[k + 1, 1] - table[k, 1])
    adhesion = table[k, 2] + part * (table[k + 1, 2] - table[k, 2])
    per_metre = (numbers[DENSITY] * GRAVITY * depth + 2.0 * surcharge) * weight
    per_metre += numbers[COHESION] * cohesion + numbers[ADHESION] * adhesion
    result: float = numbers[WIDTH] * depth * per_metre
    return result


@compiled
def strength(numbers: Array, course: Array, memory: Array) -> tuple[float, float, float]:
    """Factor on cutting, factor of this dig, and force of stones (N), at the distance travelled in soil."""
    cell = memory[at.DISTANCE] / numbers[COURSE_STEP]
    k = int(cell)
    part = cell - k
    noise = (1.0 - part) * course[k % COURSE, 0] + part * course[(k + 1) % COURSE, 0]
    dig = course[int(memory[at.DIGS]) % COURSE, 2]
    saw = 1.0 - numbers[SAWTOOTH] * (1.0 - memory[at.CHIP])
    stone = course[int(memory[at.DISTANCE] / STONE_STEP) % COURSE, 1]
    return math.exp(numbers[ROUGHNESS] * noise) * saw * dig, dig, stone


@compiled
def engage_edge(inward: float, ground: Ground, floor: tuple[float, float], c: Array) -> None:
    """Compute drag, its transverse part and edge penetration at the tip in `c`, from depth and rake.

    `inward`: 1 when the tip moves towards the machine, 0 when it moves away.
    """
    numbers, table, course, _, memory = ground
    factor, dig, stone = strength(numbers, course, memory)
    depth = c[DEPTH]
    loose = numbers[DENSITY] / numbers[SWELL]
    heap = math.sqrt(2.0 * numbers[REPOSE] * memory[at.HEAP] / (loose * numbers[WIDTH]))
    rake = math.atan2(floor[1], floor[0])
    force = inward * factor * cutting_force(depth, rake, 0.5 * loose * GRAVITY * heap, numbers, table)
    back = 0.0
    if inward < 1.0 and numbers[BACK] == 0.0:
        # The back of the bucket meets the soil at the supplementary rake, and has no heap before it.
        back = (1.0 - inward) * factor * cutting_force(depth, math.pi - rake, 0.0, numbers, table)
    along, rise = floor
    if rake < MIN_LEAN or rake > MAX_LEAN:
        lean = min(max(rake, MIN_LEAN), MAX_LEAN)
        along, rise = math.cos(lean), math.sin(lean)
    # cosine and sine of the angle of the force, rake plus friction on metal
    c[DRAG] = force * max(rise * numbers[METAL_COS] + along * numbers[METAL_SIN], 0.3) + inward * stone
    c[DRAG] += PUSHED_BACK * back
    c[ACROSS] = force * (along * numbers[METAL_COS] - rise * numbers[METAL_SIN])
    c[EDGE] = dig * numbers[CONE] * numbers[EDGE_AREA] * min(depth / EDGE_DEPTH, 1.0)


@compiled
def engage_heel(numbers: Array, heights: Array, memory: Array, c: Array) -> None:
    """Compute normal force and sliding friction of the floor plate's heel in `c`, from its depth below the profile."""
    depth, borne = c[HEEL_DEPTH], memory[at.HEEL_SET]
    if numbers[COMPACTION] > 0.0:
        borne = max(borne, rut_depth(c[POINTS + 2], heights, memory))
    bearing = min(numbers[BEKKER] * depth ** numbers[EXPONENT], numbers[BEARING_LIMIT])
    elastic = numbers[UNLOADING] * (depth - borne)
    if elastic > bearing:
        memory[at.HEEL_SET] = depth - bearing / numbers[UNLOADING]
        elastic = bearing
        if numbers[COMPACTION] > 0.0:
            bottom = c[POINTS + 3] + bearing / numbers[UNLOADING]
            press(c[POINTS + 2], bottom, numbers[COMPACTION], heights, memory)
    normal = max(elastic, 0.0)
    c[NORMAL] = normal
    c[NORMAL_DAMPING] = numbers[HEEL_DAMPING] if normal > 0.0 else 0.0
    sheared = 1.0 - math.exp(-memory[at.SHEAR] / numbers[SHEAR_LENGTH])
    stuck = numbers[ADHESION] * numbers[WIDTH] * HEEL_CONTACT if normal > 0.0 else 0.0
    c[SLIDE] = (normal * numbers[METAL_SIN] / numbers[METAL_COS] + stuck) * sheared


@compiled
def engage(state: Array, angles: Array, axes: Array, ground: Ground, c: Array) -> None:
    """Compute positions, Jacobians and forces of this step in `c`; `angles`: cosine and sine of the absolute angles."""
    numbers, _, _, heights, memory = ground
    c1, s1, ca, sa, cb, sb = angles[0], angles[1], angles[2], angles[3], angles[4], angles[5]
    elbow_x, elbow_y = axes[0, at.LENGTH] * c1, axes[0, at.LENGTH] * s1
    pin_x, pin_y = elbow_x + axes[1, at.LENGTH] * ca, elbow_y + axes[1, at.LENGTH] * sa
    tip_x, tip_y = pin_x + axes[2, at.LENGTH] * cb, pin_y + axes[2, at.LENGTH] * sb
    # the floor plate runs from the edge back into the shell
    floor_x = -(cb * numbers[FLOOR_COS] + sb * numbers[FLOOR_SIN])
    floor_y = -(sb * numbers[FLOOR_COS] - cb * numbers[FLOOR_SIN])
    heel_x, heel_y = tip_x + numbers[FLOOR_LENGTH] * floor_x, tip_y + numbers[FLOOR_LENGTH] * floor_y
    pitch, pitch_rate = memory[at.PITCH], memory[at.PITCH_RATE]
    c[POINTS], c[POINTS + 1] = tip_x - pitch * tip_y, tip_y + pitch * tip_x
    c[POINTS + 2], c[POINTS + 3] = heel_x - pitch * heel_y, heel_y + pitch * heel_x
    c[PITCHED], c[PITCHED + 1] = -tip_y * pitch_rate, tip_x * pitch_rate
    c[PITCHED + 2], c[PITCHED + 3] = -heel_y * pitch_rate, heel_x * pitch_rate
    c[TIP_JX], c[TIP_JX + 1], c[TIP_JX + 2] = -tip_y, elbow_y - tip_y, pin_y - tip_y
    c[TIP_JY], c[TIP_JY + 1], c[TIP_JY + 2] = tip_x, tip_x - elbow_x, tip_x - pin_x
    c[HEEL_JX], c[HEEL_JX + 1], c[HEEL_JX + 2] = -heel_y, elbow_y - heel_y, pin_y - heel_y
    c[HEEL_JY], c[HEEL_JY + 1], c[HEEL_JY + 2] = heel_x, heel_x - elbow_x, heel_x - pin_x
    c[EDGE_X], c[EDGE_Y] = -floor_x, -floor_y
    c[ON] = c[DRAG] = c[ACROSS] = c[EDGE] = c[NORMAL] = c[NORMAL_DAMPING] = c[SLIDE] = 0.0
    w1, w2, w3 = state[at.RATE], state[at.RATE + 1], state[at.RATE + 2]
    vx = c[TIP_JX] * w1 + c[TIP_JX + 1] * w2 + c[TIP_JX + 2] * w3 + c[PITCHED]
    # depth below the ground that the edge has not reached yet
    inward = min(max(0.5 - 0.5 * vx / TURNING, 0.0), 1.0)
    # 1.5 cells ahead: the cell of the edge itself is cut down to it already.
    uncut = inward * height_at(c[POINTS] - 1.5 * SPACING, heights)
    uncut += (1.0 - inward) * height_at(c[POINTS] + 1.5 * SPACING, heights)
    c[HEEL_DEPTH] = height_at(c[POINTS + 2], heights) - c[POINTS + 3]
    if numbers[COMPACTION] > 0.0:
        uncut -= inward * rut_depth(c[POINTS] - 1.5 * SPACING, heights, memory)
        uncut -= (1.0 - inward) * rut_depth(c[POINTS] + 1.5 * SPACING, heights, memory)
        # Within its rut the heel has no contact.
        if c[HEEL_DEPTH] <= rut_depth(c[POINTS + 2], heights, memory):
            c[HEEL_DEPTH] = 0.0
    c[DEPTH] = min(uncut - c[POINTS + 1], DEEPEST)
    if c[DEPTH] > 0.0:
        c[ON] = 1.0
        engage_edge(inward, ground, (floor_x, floor_y), c)
    if c[HEEL_DEPTH] > 0.0:
        c[ON] = 1.0
        engage_heel(numbers, heights, memory, c)
    if numbers[BACK] > 0.0:
        engage_back(w1, w2, w3, ground, c)
    if c[ON] > 0.0:
        hold(w1, w2, w3, c)
        damp(c)


@inlined
def velocities(c: Array, w1: float, w2: float, w3: float) -> Four:
    """Return the velocity of tip and heel, m/s, at these joint rates and the chassis' own."""
    tip_x = c[TIP_JX] * w1 + c[TIP_JX + 1] * w2 + c[TIP_JX + 2] * w3 + c[PITCHED]
    tip_y = c[TIP_JY] * w1 + c[TIP_JY + 1] * w2 + c[TIP_JY + 2] * w3 + c[PITCHED + 1]
    heel_x = c[HEEL_JX] * w1 + c[HEEL_JX + 1] * w2 + c[HEEL_JX + 2] * w3 + c[PITCHED + 2]
    heel_y = c[HEEL_JY] * w1 + c[HEEL_JY + 1] * w2 + c[HEEL_JY + 2] * w3 + c[PITCHED + 3]
    return tip_x, tip_y, heel_x, heel_y


@compiled
def engage_back(w1: float, w2: float, w3: float, ground: Ground, c: Array) -> None:
    """Add the soil resistance on the back to the forces in `c`, at the lower of tip and heel."""
    v = velocities(c, w1, w2, w3)
    back, tip_lower = ground[0][BACK:], c[POINTS + 1] <= c[POINTS + 3]
    outward = min(max(0.5 + 0.5 * (v[0] if tip_lower else v[2]) / TURNING, 0.0), 1.0)
    c[PUSH_DEPTH], push = bucket_back.measure_soil_ahead(c[POINTS : POINTS + 4], ground[3], ground[4], back)
    if outward > 0.0 and c[PUSH_DEPTH] > 0.0:
        c[ON] = 1.0
        push *= outward * strength(ground[0], ground[2], ground[4])[0]
        if tip_lower:
            c[DRAG] += push
            # Friction on the back lifts the floor plate, more at steeper angles.
            c[ACROSS] += push * back[bucket_back.LIFT] * -c[EDGE_Y]
        else:
            c[SLIDE] += push


@inlined
def forces(c: Array, v: Four) -> Four:
    """Force (N) of the ground on tip and on heel at their velocities, with the dampers of this step, see `hold`."""
    into = c[EDGE] * (v[0] * c[EDGE_X] + v[1] * c[EDGE_Y])
    fx = -c[DRAG] * v[0] - c[ACROSS] * v[1] - into * c[EDGE_X]
    fy = -c[DRAG] * v[1] + c[ACROSS] * v[0] - into * c[EDGE_Y]
    return fx, fy, -c[SLIDE] * v[2], c[NORMAL] - c[NORMAL_DAMPING] * v[3]


@inlined
def torques(c: Array, w1: float, w2: float, w3: float) -> tuple[float, float, float]:
    """Return the joint torques (N m) of the ground at these joint rates."""
    fx, fy, hx, hy = forces(c, velocities(c, w1, w2, w3))
    return (
        c[TIP_JX] * fx + c[TIP_JY] * fy + c[HEEL_JX] * hx + c[HEEL_JY] * hy,
        c[TIP_JX + 1] * fx + c[TIP_JY + 1] * fy + c[HEEL_JX + 1] * hx + c[HEEL_JY + 1] * hy,
        c[TIP_JX + 2] * fx + c[TIP_JY + 2] * fy + c[HEEL_JX + 2] * hx + c[HEEL_JY + 2] * hy,
    )


@compiled
def hold(w1: float, w2: float, w3: float, c: Array) -> None:
    """Convert forces of constant magnitude to dampers for one step, from the velocities at its start.

    Force over speed does not move within a step: both stages of the integrator see the linear damper that its
    Jacobian knows. A force that keeps its size while the velocity turns round is what ROS2 would amplify, by 2.4 a
    step where soil is stiff against the mass of the bucket.
    """
    v = velocities(c, w1, w2, w3)
    slow = 1.0 / math.sqrt(v[0] * v[0] + v[1] * v[1] + CREEP * CREEP)
    c[DRAG] *= slow
    c[ACROSS] *= slow
    into = v[0] * c[EDGE_X] + v[1] * c[EDGE_Y]
    c[EDGE] = c[EDGE] / math.sqrt(into * into + CREEP * CREEP) if into > 0.0 else 0.0
    c[SLIDE] /= math.sqrt(v[2] * v[2] + CREEP * CREEP)
    if c[NORMAL] < c[NORMAL_DAMPING] * v[3]:
        c[NORMAL] = c[NORMAL_DAMPING] = 0.0  # leaves faster than the soil follows: it does not pull


@compiled
def damp(c: Array) -> None:
    """Write the damping of the joints by the soil, N m s, to `c[DAMPING:]` by rows: minus the Jacobian of `torques`."""
    drag, edge, slide, across = c[DRAG], c[EDGE], c[SLIDE], c[ACROSS]
    xx, xy, yy = drag + edge * c[EDGE_X] * c[EDGE_X], edge * c[EDGE_X] * c[EDGE_Y], drag + edge * c[EDGE_Y] * c[EDGE_Y]
    for i in range(3):
        for j in range(3):
            ix, iy, jx, jy = c[TIP_JX + i], c[TIP_JY + i], c[TIP_JX + j], c[TIP_JY + j]
            value = xx * ix * jx + xy * (ix * jy + iy * jx) + yy * iy * jy + across * (ix * jy - iy * jx)
            value += slide * c[HEEL_JX + i] * c[HEEL_JX + j] + c[NORMAL_DAMPING] * c[HEEL_JY + i] * c[HEEL_JY + j]
            c[DAMPING + 3 * i + j] = value


@compiled
def rock(h: float, numbers: Array, memory: Array, c: Array, force: Four, at_rest: float) -> None:
    """Compute the pitch of the chassis over one step: a spring on its tracks that yields at the lifting moment."""
    tip_x, tip_y, heel_x, heel_y = c[TIP_JY], -c[TIP_JX], c[HEEL_JY], -c[HEEL_JX]
    moment = tip_x * force[1] - tip_y * force[0] + heel_x * force[3] - heel_y * force[2]
    limit = numbers[LIFT_MOMENT]
    moment -= min(max(numbers[PITCH_STIFFNESS] * memory[at.PITCH], -limit), limit)
    # soil at the tip brakes the chassis too: implicit, with the drag of this step
    own = c[DAMPING] * at_rest
    gain = h / numbers[PITCH_INERTIA]
    rate = memory[at.PITCH_RATE]
    rate = (rate + gain * (moment + own * rate)) / (1.0 + gain * (numbers[PITCH_DAMPING] + own))
    memory[at.PITCH_RATE] = rate
    memory[at.PITCH] += h * rate
