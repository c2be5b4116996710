"""Machines by name or from a TOML file, checked before the first step."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from edp.errors import ConfigError, closest
from edp.sim.machine.family import MASSES_T, WIDEST, Draws, member_mass, member_name, scale_machine
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import MACHINE_FILE, check_machine
from edp.storage import SETTINGS_BYTES, parse_toml, read_text
from edp.storage.paths import full_path
from edp.wording import typed

FAMILY = re.compile(
    r"FAMILY-(\d{1,9})-(\d{1,6})(?:-(\d{1,3}(?:P\d{1,3})?)-(\d{1,3}(?:P\d{1,3})?))?(?:-X(\d(?:P\d{1,3})?))?"
)
"""Pattern of the name of a machine in a family, see `member_name`. Such a machine has no file."""


def machine_names() -> tuple[str, ...]:
    """Return the names of the machines that come with the package."""
    files = resources.files("edp.sim").joinpath("machines").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml").upper() for f in files if f.name.endswith(".toml")))


def load_machine(name: str) -> Machine:
    """Load a machine by name (case-insensitive, also a `member_name` of a family) or from a TOML file.

    Raises:
        ConfigError: no such machine (the closest name is offered) or file; or the file lacks or misnames a key, or
            a value is out of its bounds, or the linkage is impossible: file, key, value and bound are named.
    """
    if name.lower().endswith(".toml"):
        path = Path(name)
        try:
            # Part of the cache's key: an edited file is another machine.
            changed = path.stat().st_mtime_ns
        except OSError as error:
            raise ConfigError(
                f"machine file {name} cannot be read: {error.strerror}; give the path of a TOML file, "
                f"or one of the names {', '.join(machine_names())}"
            ) from error
        # Resolved, since a relative name means another file once the current folder has changed.
        return _from_file(full_path(path), changed)
    return _load_built_in(name.upper())


@cache
def _from_file(path: Path, changed: int) -> Machine:
    """Read a machine file; `changed` is its time stamp, so that an edited file is read again."""
    return parse_machine(read_text(path, SETTINGS_BYTES, f"machine file {path}", ConfigError), path.name)


@cache
def _load_built_in(name: str) -> Machine:
    member = _member(name)
    if member is not None:
        return family_member(*member)
    names = machine_names()
    if name not in names:
        raise ConfigError(f"unknown machine '{name}'{closest(name, names)}; or give the path of a .toml file")
    source = resources.files("edp.sim").joinpath("machines").joinpath(f"{name.lower()}.toml")
    return parse_machine(source.read_text(encoding="utf-8"), source.name)


def _member(name: str) -> tuple[int, int, float, float, float] | None:
    """Seed, index, range of masses (t) and scatter of a machine of a family, by its name; None for any other."""
    match = FAMILY.fullmatch(name.upper())
    if match is None:
        return None
    usual = (*MASSES_T, 1.0)
    low, high, scatter = (
        middle if text is None else float(text.replace("P", "."))
        for text, middle in zip(match.group(3, 4, 5), usual, strict=True)
    )
    return int(match[1]), int(match[2]), low, high, scatter


def look_up_mass(name: str) -> float | None:
    """Return the operating weight (t) of a machine of a family.

    None for other machines, whose file does not state it.
    """
    member = _member(name)
    return None if member is None else member_mass(*member[:4])


def family_member(
    seed: int, index: int, low_t: float = MASSES_T[0], high_t: float = MASSES_T[1], scatter: float = 1.0
) -> Machine:
    """Return the machine `index` of the family of `seed`: M22 scaled to a mass from `low_t` to `high_t`, with scatter.

    It is also `load_machine` of its `member_name`, such as "family-0-3" and "family-0-3-10-20-x2".

    Raises:
        ConfigError: the range of masses is empty or out of bounds, or the scatter is.
    """
    if not 0.0 < scatter <= WIDEST:
        raise ConfigError(f"family with scatter = {scatter}; must be above 0 and at most {typed(WIDEST)}")
    draws = Draws(np.random.default_rng([seed, 1 + index]), scatter)
    mass = member_mass(seed, index, low_t, high_t)
    name = member_name(seed, index, (low_t, high_t), scatter)
    machine = scale_machine(_load_built_in("M22"), mass, draws, name)
    check_machine(machine, name)
    return machine


def machine_family(
    count: int, seed: int, low_t: float = MASSES_T[0], high_t: float = MASSES_T[1], scatter: float = 1.0
) -> tuple[Machine, ...]:
    """Return `count` machines from `low_t` to `high_t`, each with its own scatter.

    The same seed gives the same machines.
    """
    return tuple(family_member(seed, index, low_t, high_t, scatter) for index in range(count))


def parse_machine(text: str, where: str) -> Machine:
    """Read and check a machine from TOML text; `where` names the file in messages.

    Raises:
        ConfigError: not TOML, a key is missing or unknown, or a value cannot be (see `machine_checks`).
    """
    machine = MACHINE_FILE.build(Machine, parse_toml(text, f"machine file {where}", ConfigError), where)
    check_machine(machine, where)
    return machine
