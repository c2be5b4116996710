"""Machine: parameters of one excavator front. Machine files are read and checked in `machine_files`."""

from __future__ import annotations

from dataclasses import dataclass

Triple = tuple[float, float, float]
PumpNumbers = tuple[int, int, int]
"""Pump index (1 or 2) of each cylinder, as integers."""
Rating = tuple[float, float]
"""Rated flow (L/min) and the pressure difference (bar) of this flow."""
Ratings = tuple[Rating, Rating, Rating]


@dataclass(frozen=True)
class Bodies:
    """Boom, arm and bucket as planar rigid bodies: SI units, centre of mass in the body's own frame."""

    length: Triple
    mass: Triple
    com_x: Triple
    com_y: Triple
    inertia: Triple


@dataclass(frozen=True)
class PinTriangle:
    """A cylinder between two pins around a joint (cosine law); lengths in m."""

    base_radius: float
    rod_radius: float
    offset_deg: float
    closed_length: float


@dataclass(frozen=True)
class BucketLinkage:
    """Rocker and link between bucket cylinder and bucket, in the arm frame; lengths in m, angle in rad."""

    pivot_to_pin: float
    pivot_offset: float
    rocker: float
    link: float
    lug: float
    lug_angle: float
    cylinder_pin: tuple[float, float]
    closed_length: float


@dataclass(frozen=True)
class Cylinders:
    """Sizes, cushions, stops and leakage; SI units.

    The parameters of `edp.sim.physics.lines` are optional; without them a line is part of its chamber.

    Attributes:
        line_bore: bore of the line from the valve to each chamber, m; its length follows from `hose_volume`.
        line_modulus: bulk modulus of each line's walls (pressure over relative growth of its volume), Pa; 0 if rigid.
    """

    count: Triple
    bore: Triple
    rod: Triple
    stroke: Triple
    hose_volume: Triple
    dead_length: float
    cushion_length: Triple
    cushion_area: Triple
    stop_stiffness: float
    stop_damping: float
    piston_leakage: Triple
    spool_leakage: Triple
    line_bore: Triple = (0.0, 0.0, 0.0)
    line_modulus: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Friction:
    """LuGre parameters; Coulomb and static force as a fraction of head area times 34.3 MPa."""

    coulomb_fraction: float
    static_fraction: float
    viscous: Triple
    stribeck_velocity: float
    bristle_stiffness: Triple
    bristle_damping: Triple


@dataclass(frozen=True)
class Oil:
    """Oil and tank; SI units, temperatures in degC: at the start and around; heat capacity J/K, cooling W/K."""

    bulk_modulus: float
    air_fraction: float
    viscosity: float
    temperature: float
    tank_pressure: float
    heat_capacity: float
    cooling: float
    ambient: float


@dataclass(frozen=True)
class Pumps:
    """Two equal pumps with electronic positive control, or with load sensing; SI units.

    The engine parameters are optional; without them the engine speed is constant.

    Attributes:
        load_margin: pressure of each pump above its highest load, Pa; 0 for positive control.
        engine_droop: speed drop of the engine from no load to full power, as a fraction of the governed speed.
        engine_power: full power of the engine, W.
        engine_inertia: inertia of engine, flywheel and pumps, kg m^2.
        engine_speed_rpm: governed speed without load, 1/min; `max_flow` belongs to it.
    """

    max_flow: float
    volumetric_efficiency: float
    power_limit: float
    min_displacement: float
    time_constant: float
    line_volume: float
    relief: float
    relief_slope: float
    bypass: Rating
    bypass_closed_at: float
    engine_droop: float = 0.0
    engine_power: float = 0.0
    engine_inertia: float = 0.0
    engine_speed_rpm: float = 0.0
    load_margin: float = 0.0


@dataclass(frozen=True)
class Valves:
    """Command path and main control valve; ratings are (L/min, bar) at full opening.

    Attributes:
        flow_sharing: one of `edp.sim.machine.parameters.FLOW_SHARING`.
        compensator_drop: pressure drop that a compensator keeps across its section, Pa; only for `pre_compensated`.
    """

    pilot_pressure: float
    pilot_frequency: Triple
    spool_frequency: Triple
    conflux_spool_frequency: Triple
    dead_time: Triple
    conflux_extra_dead_time: float
    dead_band_extend: Triple
    dead_band_retract: Triple
    conflux_dead_band_extend: Triple
    conflux_dead_band_retract: Triple
    hysteresis: float
    lever_dead_zone: float
    conflux_start: float
    conflux_extend: Triple
    conflux_retract: Triple
    pump_demand_extend: Triple
    pump_demand_retract: Triple
    primary_pump: PumpNumbers
    conflux_pump: PumpNumbers
    meter_in_extend: Ratings
    meter_in_retract: Ratings
    conflux_in_extend: Ratings
    conflux_in_retract: Ratings
    meter_out_extend: Ratings
    meter_out_retract: Ratings
    regeneration_extend: Ratings
    regeneration_retract: Ratings
    check_leakage: float
    port_relief_head: Triple
    port_relief_rod: Triple
    port_relief_slope: float
    anti_cavitation: Rating
    flow_sharing: str
    compensator_drop: float = 0.0


@dataclass(frozen=True)
class Bucket:
    """Soil-related parameters of the bucket; SI units.

    Attributes:
        width: cutting width.
        capacity: struck volume, m^3.
        floor_angle_deg: angle from the line tip-pin to the floor plate, towards the shell.
        floor_length: distance from the cutting edge to the heel.
        edge_area: frontal area of lip and teeth, m^2.
        load_x: centre of a full load along the line pin-tip.
        load_y: the coordinate across it, towards the shell.
    """

    width: float
    capacity: float
    floor_angle_deg: float
    floor_length: float
    edge_area: float
    load_x: float
    load_y: float


@dataclass(frozen=True)
class Chassis:
    """Compliance of the undercarriage; SI units.

    Attributes:
        boom_foot_height: height of the boom foot above level ground.
        pitch_inertia: moment of inertia about the tipping line, kg m^2.
        pitch_frequency: frequency of rocking on the tracks, Hz.
        pitch_damping: damping ratio of the pitch motion.
        lift_moment: pitching moment at which the front of the tracks leaves the ground, N m.
    """

    boom_foot_height: float
    pitch_inertia: float
    pitch_frequency: float
    pitch_damping: float
    lift_moment: float


@dataclass(frozen=True)
class Motor:
    """A hydraulic motor with its gear and its section of the main valve, by the motion that it makes; SI units.

    Of `travel` the motion is that of one track in m, and every number is that of one track.

    Attributes:
        pump: 1 or 2, that feeds it; of `travel` the left track's, the right one has the other.
        displacement: volume swept for 1 rad (of a track: 1 m) of motion, m^3.
        inertia: kg m^2 (kg) that it moves; of `swing` without the front, whose own follows from its pose.
        volume: volume of each port with its line, m^3.
        leakage: between the ports, m^3/s/Pa.
        drain_leakage: leakage from each port to tank, m^3/s/Pa.
        coulomb: dry friction and rolling resistance, N m (N).
        viscous: N m s (N s/m).
        brake: torque (force) of the parking brake, N m (N).
        brake_delay: s after which it falls in, once its spool has closed.
        relief: pressure at which the valve of each port opens, Pa.
        relief_slope: flow through it for each Pa above, m^3/s/Pa.
        pilot_frequency: Hz, as in `Valves`.
        spool_frequency: Hz.
        dead_time: dead time of its command, s.
        dead_band: dead band in both directions, as a fraction of the full spool travel.
        pump_demand: pump displacement demanded by full pilot pressure, as a fraction of the full displacement.
        meter_in: area from the pump, at full opening.
        meter_out: area to the tank, at full opening.
    """

    pump: int
    displacement: float
    inertia: float
    volume: float
    leakage: float
    drain_leakage: float
    coulomb: float
    viscous: float
    brake: float
    brake_delay: float
    relief: float
    relief_slope: float
    pilot_frequency: float
    spool_frequency: float
    dead_time: float
    dead_band: float
    pump_demand: float
    meter_in: Rating
    meter_out: Rating


@dataclass(frozen=True)
class SwingMotor(Motor):
    """The motor that swings the upper structure.

    Attributes:
        boom_foot_ahead: distance of the boom foot ahead of the swing axis, m.
    """

    boom_foot_ahead: float


@dataclass(frozen=True)
class Sensors:
    """Errors of sensors and bus; SI units, degrees where the name states it; zero disables an error.

    Attributes:
        velocity: white noise of each cylinder velocity, rms.
        pressure: white noise of each cylinder pressure, rms.
        acceleration_bandwidth: bandwidth of the differentiated velocity, Hz.
        joint_rate_deg: white error of each joint rate, deg/s rms; times the lever arm in the velocity.
        joint_bias_walk_deg: random walk of its bias, deg/s per root of a minute.
        angle_quantum_deg: quantum of the joint angles, from which the lever arms follow.
        pin_backlash: play of the pins between cylinder and joint, m.
        pressure_range: full scale of a pressure transmitter, from 0.
        pressure_offset: smallest and largest magnitude of a sensor's offset, as fractions of full scale.
        pressure_bits: resolution of full scale.
        pressure_lag: time constant, s.
        pressure_drift: temperature drift of a pressure sensor, as a fraction of full scale per K of oil temperature
            away from 40 degC.
        can_period: time between frames of an ECU, s; 0 for no bus.
        can_latency: shortest and longest latency, s.
        can_jitter: rms of the latency, s.
        can_loss: fraction of lost frames.
        instance_seed: seed of the instance, together with the machine's name: offsets, clock phases, latencies.
        pressure_at: location of the pressure transmitters: "cylinder" or, if lines are modelled, "valve".
    """

    velocity: float
    pressure: float
    acceleration_bandwidth: float
    joint_rate_deg: float
    joint_bias_walk_deg: float
    angle_quantum_deg: float
    pin_backlash: Triple
    pressure_range: float
    pressure_offset: tuple[float, float]
    pressure_bits: int
    pressure_lag: float
    pressure_drift: float
    can_period: float
    can_latency: tuple[float, float]
    can_jitter: float
    can_loss: float
    instance_seed: int
    pressure_at: str = "cylinder"


@dataclass(frozen=True)
class Machine:
    """One parameter set of the simulator; order of triples: boom, arm, bucket.

    Swing and travel are optional, but only together. They move only with excitations that use them.
    """

    name: str
    description: str
    gravity: float
    bodies: Bodies
    boom_cylinder: PinTriangle
    arm_cylinder: PinTriangle
    bucket_linkage: BucketLinkage
    cylinders: Cylinders
    friction: Friction
    oil: Oil
    pumps: Pumps
    valves: Valves
    bucket: Bucket
    chassis: Chassis
    sensors: Sensors
    swing: SwingMotor | None = None
    travel: Motor | None = None
