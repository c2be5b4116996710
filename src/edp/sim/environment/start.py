"""Start of an environment's next episode: settings, overrides of `reset`, and a random machine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.settings.bounds import shown
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
"""Options besides: strokes to start from (shares of full), and the oil's temperature at the start (degC)."""
MOST_SEED = 2**31 - 1


def episode_start(spec: EnvironmentSpec, seed: int, options: Table | None) -> tuple[EpisodeStart, dict[str, object]]:
    """Return the start of an episode, and its description for `info`.

    Raises:
        ConfigError: an option is unknown (the closest is offered) or out of range.
    """
    options = dict(options or {})
    for name in options:
        if name not in (*OF_SPEC, *OWN):
            raise ConfigError(f"reset: option '{name}' is unknown{closest(str(name), [*OF_SPEC, *OWN])}")
    overrides = {name: value for name, value in options.items() if name in OF_SPEC}
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
    facts: dict[str, object] = {"seed": seed, "machine": machine.name, "material": spec.material}
    if spec.faults:
        facts["faults"] = "; ".join(map(fault_text, spec.faults))
    mass_t = look_up_mass(machine.name)
    return start, facts if mass_t is None else {**facts, "mass_t": mass_t}


def check_mask(lanes: int, mask: Any) -> NDArray[np.bool_]:
    """Return the mask of environments that restart, shape ``(lanes,)``; all of them without a mask.

    Raises:
        ConfigError: another shape or type, or no lane at all.
    """
    if mask is None:
        return np.ones(lanes, dtype=np.bool_)
    array = np.asarray(mask)
    if array.shape != (lanes,) or array.dtype != np.bool_ or not array.any():
        raise ConfigError(
            f"reset: reset_mask of shape {array.shape} and type {array.dtype}; give {lanes} booleans, of which one at "
            "least is True"
        )
    return array


def check_seed(seed: Any) -> int | None:
    """Return a seed checked for Gymnasium.

    Raises:
        ConfigError: it is no whole number, or negative.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"reset: seed = {shown(seed)}; give a whole number that is not negative, or None")
    return int(seed)


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
