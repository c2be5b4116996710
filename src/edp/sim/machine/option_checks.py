"""Requirements on optional machine parts: engine, load sensing, long lines, motors; contradictions are refused."""

from __future__ import annotations

import math

from edp.errors import ConfigError
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import conductance
from edp.sim.physics import lines
from edp.wording import typed

CYLINDERS = ("boom", "arm", "bucket")
MAX_BLED = 0.1
"""Maximum fraction of a pump's flow that a load-sensing block bleeds at its margin."""
MIN_BORE = 1e-3
"""Minimum bore of a line, m. A narrower line acts as an orifice, and its length has no effect."""
SOFTEST = 1e7
"""Minimum bulk modulus of hose walls, Pa. Real hoses have 1e8 to 1e9 Pa."""
LINE_LENGTHS = 0.3, 60.0
"""Accepted line lengths, m. Shorter lines belong to their chamber; excavators have no longer lines."""


def check_engine(machine: Machine, where: str) -> None:
    """Check that all or no engine parameters are given, and that the power suffices for the pumps."""
    pumps = machine.pumps
    keys = ("engine_droop", "engine_power", "engine_inertia", "engine_speed_rpm")
    absent = [key for key in keys if getattr(pumps, key) == 0.0]
    if absent and len(absent) < len(keys):
        raise ConfigError(
            f"machine file {where} [pumps]: {', '.join(absent)} must be above 0 where the other numbers of the engine "
            f"are; give all of {', '.join(keys)}, or none for an engine that turns at one speed"
        )
    if not absent and pumps.engine_power < pumps.power_limit:
        raise ConfigError(
            f"machine file {where} [pumps]: engine_power = {pumps.engine_power!r} W must be at least power_limit = "
            f"{pumps.power_limit!r} W, or the pumps stall the engine"
        )


def check_load_sensing(machine: Machine, where: str) -> None:
    """Check the bleed, which must carry the least flow slightly below the margin, and the compensators."""
    pumps, valves = machine.pumps, machine.valves
    if (valves.compensator_drop > 0.0) != (valves.flow_sharing == "pre_compensated"):
        raise ConfigError(
            f"machine file {where} [valves]: compensator_drop = {valves.compensator_drop!r} Pa with flow_sharing = "
            f"{valves.flow_sharing!r}; must be above 0 with 'pre_compensated', and 0 or left out with any other"
        )
    if pumps.load_margin == 0.0:
        return
    if valves.compensator_drop > pumps.load_margin:
        raise ConfigError(
            f"machine file {where} [valves]: compensator_drop = {valves.compensator_drop!r} Pa must be at most "
            f"load_margin = {pumps.load_margin!r} Pa of [pumps], or no compensator ever regulates"
        )
    if pumps.load_margin >= pumps.relief:
        raise ConfigError(
            f"machine file {where} [pumps]: load_margin = {pumps.load_margin!r} Pa must be below relief = "
            f"{pumps.relief!r} Pa"
        )
    bled = conductance(pumps.bypass) * math.sqrt(pumps.load_margin)
    least, most = pumps.min_displacement * pumps.max_flow, MAX_BLED * pumps.max_flow
    if not least <= bled <= most:
        raise ConfigError(
            f"machine file {where} [pumps]: bypass = {list(pumps.bypass)!r} bleeds {typed(bled * 6e4, 3)} L/min at "
            f"load_margin = {pumps.load_margin!r} Pa; with load sensing the centre is closed but for a bleed, from "
            f"{typed(least * 6e4, 3)} L/min (min_displacement, which must go somewhere) to {typed(most * 6e4, 3)} "
            "L/min "
            f"({typed(MAX_BLED)} of max_flow); change bypass or min_displacement"
        )


def check_lines(machine: Machine, where: str) -> None:
    """Check that all or no line bores are given, lengths are possible, and no line parameters occur without lines."""
    cylinders = machine.cylinders
    if not lines.modelled(cylinders):
        for section, key, present in (
            ("cylinders", "line_modulus", any(cylinders.line_modulus)),
            ("sensors", "pressure_at", machine.sensors.pressure_at == "valve"),
        ):
            if present:
                raise ConfigError(
                    f"machine file {where} [{section}]: {key} = {getattr(getattr(machine, section), key)!r} asks for "
                    "lines between valve and cylinders; give line_bore in [cylinders], too, or leave it out"
                )
        return
    if min(cylinders.line_bore) < MIN_BORE:
        raise ConfigError(
            f"machine file {where} [cylinders]: line_bore = {list(cylinders.line_bore)!r} must be at least "
            f"{typed(MIN_BORE)} m for all cylinders, or 0 for all"
        )
    for name, modulus in zip(CYLINDERS, cylinders.line_modulus, strict=True):
        if 0.0 < modulus < SOFTEST:
            raise ConfigError(
                f"machine file {where} [cylinders]: line_modulus[{name}] = {modulus!r} Pa must be at least "
                f"{typed(SOFTEST)}, or 0 for a rigid line"
            )
    for name, bore, length in zip(CYLINDERS, cylinders.line_bore, lines.lengths(cylinders), strict=True):
        if not LINE_LENGTHS[0] <= length <= LINE_LENGTHS[1]:
            raise ConfigError(
                f"machine file {where} [cylinders]: line_bore[{name}] = {bore!r} m makes of hose_volume[{name}] a line "
                f"of {typed(length, 3)} m; must be from {typed(LINE_LENGTHS[0])} to {typed(LINE_LENGTHS[1])} m"
            )


def check_motors(machine: Machine, where: str) -> None:
    """Check that swing and travel are both present or both absent, and that motors overcome their own friction."""
    if (machine.swing is None) != (machine.travel is None):
        absent = "swing" if machine.swing is None else "travel"
        raise ConfigError(
            f"machine file {where}: the table [{absent}] is missing; give both [swing] and [travel], or neither"
        )
    if machine.swing is None or machine.travel is None:
        return
    for section, motor in (("swing", machine.swing), ("travel", machine.travel)):
        # The pump's relief opens first where it is the lower one.
        most = motor.displacement * (min(motor.relief, machine.pumps.relief) - machine.oil.tank_pressure)
        if motor.coulomb >= most:
            raise ConfigError(
                f"machine file {where} [{section}]: coulomb = {motor.coulomb!r} must be below what the motor gives at "
                f"its relief, {typed(most)} (displacement times pressure), or it never moves"
            )
