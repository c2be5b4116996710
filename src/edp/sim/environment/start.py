"""Start of an environment's next episode: settings, overrides of `reset`, and a random machine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from edp.errors import ConfigError, closest
from edp.sim.environment.batch import Infos, Options
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.episodes.episodes import EpisodeStart
from edp.sim.faults import fault_text
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import check_machine
from edp.sim.machine.machine_files import family_member, look_up_mass
from edp.storage.reading import Table

OF_SPEC = (
    "machine",
    "material",
    "sensor_noise",
    "hand",
    "loop_latency",
    "lost_frames",
    "start_strokes",
    "sensors",
    "faults",
)
"""Settings that the options of a reset may override for one episode."""
OWN = ("strokes", "oil_temperature")
"""Additional options of a reset: initial strokes (fractions of the full stroke) and initial oil temperature (degC)."""
MAX_SEED = 2**31 - 1


def episode_start(spec: EnvironmentSpec, seed: int, options: Options) -> tuple[EpisodeStart, Infos]:
    """Return the start of an episode, and its description for `info`.

    Raises:
        ConfigError: an option is unknown (the closest is offered) or out of range.
    """
    for name in options:
        if name not in (*OF_SPEC, *OWN):
            raise ConfigError(f"reset: option '{name}' is unknown{closest(str(name), [*OF_SPEC, *OWN])}")
    overrides: Table = {name: value for name, value in options.items() if name in OF_SPEC}
    if "machine" in overrides and spec.randomise is not False:
        raise ConfigError("reset: option 'machine' and an environment that draws machines (randomise); leave one out")
    if overrides:
        spec = replace(spec, **overrides)
    scenario = spec.scenario(seed)
    machine = _draw_machine(spec, seed) if spec.randomise is not False else scenario.load()
    if "oil_temperature" in options:
        machine = _set_oil_temperature(machine, options["oil_temperature"])
    start = EpisodeStart(
        scenario, machine, spec.hand, spec.loop_latency, spec.lost_frames, _strokes(options.get("strokes"))
    )
    facts: Infos = {"seed": seed, "machine": machine.name, "material": spec.material}
    if spec.faults:
        facts["faults"] = "; ".join(map(fault_text, spec.faults))
    mass_t = look_up_mass(machine.name)
    return start, facts if mass_t is None else {**facts, "mass_t": mass_t}


def _draw_machine(spec: EnvironmentSpec, seed: int) -> Machine:
    """Return the random machine of the family for this seed."""
    low, high = spec.masses_t
    # A family of its own for each seed, so that its first member has any mass.
    family = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0]) % 10**9
    return family_member(family, 0, low, high, spec.spread)


def _set_oil_temperature(machine: Machine, celsius: Any) -> Machine:
    try:
        warmed = replace(machine, oil=replace(machine.oil, temperature=float(celsius)))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"reset: oil_temperature = {celsius!r}; give a number in degC") from error
    check_machine(warmed, f"{machine.name} with the reset's oil_temperature")
    return warmed


def _strokes(strokes: Any) -> tuple[float, float, float] | None:
    if strokes is None:
        return None
    try:
        boom, arm, bucket = (float(stroke) for stroke in strokes)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"reset: strokes = {strokes!r}; give three shares of full stroke from 0 to 1") from error
    if not all(0.0 <= stroke <= 1.0 for stroke in (boom, arm, bucket)):
        raise ConfigError(f"reset: strokes = {[boom, arm, bucket]}; give three shares of full stroke from 0 to 1")
    return boom, arm, bucket
