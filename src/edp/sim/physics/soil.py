"""Soil: materials read from `materials/<name>.toml`, and the ground of one recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.settings.bounds import above, check_bounds, span
from edp.settings.tree import SettingsTree
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.physics import ground_profile, terramechanics
from edp.storage import SETTINGS_BYTES, parse_toml, read_text
from edp.wording import setting_text, typed

Array = NDArray[np.float64]
SPACING_M = ground_profile.SPACING
"""Cell (m) of the height profile."""
BEYOND_M = 1.0
"""How far the ground goes on beyond the machine's reach."""
UNEVENNESS_M = 0.04
"""Deviation (m) of the surface at its bends, a metre apart."""


BOUNDS = {
    "density": span(500.0, 3500.0),
    "cohesion": span(0.0, 2e5),
    "friction_deg": span(0.0, 50.0),
    "metal_friction_deg": span(0.0, 40.0),
    "adhesion": span(0.0, 1e5),
    "bekker_exponent": span(0.1, 2.0),
    "bekker_cohesive": span(0.0, 1e7),
    "bekker_frictional": span(1e4, 1e9),
    "shear_length": span(1e-3, 0.2),
    "cone_index": above(0.0, 1e9),
    "swell": span(1.0, 2.0),
    "repose_deg": span(10.0, 60.0),
    "roughness": span(0.0, 0.6),
    "roughness_length": span(0.02, 5.0),
    "stones_per_m": span(0.0, 10.0),
    "sawtooth": span(0.0, 0.9),
    "compaction": span(0.0, 1.0),
    "back_push": span(0.0, 1.0),
    "back_friction_deg": span(0.0, 40.0),
}
"""Of a material; the softest mud has a cone index of some kPa, rock has no cone index."""


@dataclass(frozen=True)
class Material:
    """One soil; SI units, angles in degrees. `cone_index` is a range from which each ground draws.

    Attributes:
        density: density in the bank, kg/m^3.
        bekker_exponent: n of p = (k_c / b + k_phi) z^n.
        shear_length: Janosi's K.
        swell: loose over bank volume.
        roughness: spread of the logarithm of the resistance along the way.
        roughness_length: length over which it varies, m.
        sawtooth: share of the resistance lost when a chip breaks off.
        compaction: share of the heel's lasting sinkage, up to 0.1 m of it, that stays as a rut once the heel has left.
        back_push: share of the soil in the way of the bucket's back that it pushes ahead; the rest flows around it and
            lies behind. 0: the back meets resistance and moves no soil.
        back_friction_deg: friction angle of the soil on the back while it pushes, at most that of the soil.

    Raises:
        ConfigError: a value is out of its bounds, or friction of a back that pushes nothing or more than the soil has.
    """

    name: str
    description: str
    density: float
    cohesion: float
    friction_deg: float
    metal_friction_deg: float
    adhesion: float
    bekker_exponent: float
    bekker_cohesive: float
    bekker_frictional: float
    shear_length: float
    cone_index: tuple[float, float]
    swell: float
    repose_deg: float
    roughness: float
    roughness_length: float
    stones_per_m: float
    sawtooth: float
    compaction: float = 0.0
    back_push: float = 0.0
    back_friction_deg: float = 0.0

    def __post_init__(self) -> None:
        check_bounds("material", self, **BOUNDS)
        if self.back_friction_deg > 0.0 and self.back_push == 0.0:
            raise ConfigError(
                f"material: back_friction_deg = {setting_text(self.back_friction_deg)} needs a back that pushes soil; "
                "give back_push, too, or leave both out"
            )
        if self.back_friction_deg > self.friction_deg:
            raise ConfigError(
                f"material: back_friction_deg = {setting_text(self.back_friction_deg)} must be at most friction_deg = "
                f"{typed(self.friction_deg)}; beyond it soil slides on soil"
            )
        if self.cone_index[0] > self.cone_index[1]:
            raise ConfigError(f"material: cone_index = {list(self.cone_index)} Pa; the smaller one must come first")


MATERIAL_FILE = SettingsTree(what="material file")


def material_names() -> tuple[str, ...]:
    """Names of the materials that come with the package."""
    files = resources.files("edp.sim").joinpath("materials").iterdir()
    return tuple(sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml")))


@cache
def load_material(name: str) -> Material:
    """Load a material by name, or from the user's TOML file (a path that ends in ``.toml``).

    Raises:
        ConfigError: no such material (the closest name is offered), or a value is missing, unknown or out of bounds.
    """
    if name.endswith(".toml"):
        return parse_material(read_text(name, SETTINGS_BYTES, f"material file {name}", ConfigError), name)
    names = material_names()
    if name not in names:
        raise ConfigError(f"unknown material '{name}'{closest(name, names)}; there are {', '.join(names)}")
    source = resources.files("edp.sim").joinpath("materials").joinpath(f"{name}.toml")
    return parse_material(source.read_text(encoding="utf-8"), f"{name}.toml")


def parse_material(text: str, where: str) -> Material:
    """Read a material from TOML text; `where` names the file in messages.

    Raises:
        ConfigError: not TOML, or a value is missing, unknown or out of bounds.
    """
    table = parse_toml(text, f"material file {where}", ConfigError)
    return MATERIAL_FILE.build(Material, table, where)


class Ground:
    """Ground in front of one machine: height profile along its reach, load in the bucket, and soil parameters.

    Heights are of soil at bank density, so that the mass of soil in profile, heap and bucket stays the same; the
    surface lies lower where the heel has pressed it.

    Args:
        material: soil.
        machine: machine whose bucket digs; defines height of the boom foot and reach.
        rng: draws unevenness, strength, stones and the course of the resistance, all of it at once.
    """

    spacing_m = SPACING_M
    start_m = 0.0

    def __init__(self, material: Material, machine: Machine, rng: np.random.Generator) -> None:
        self.material = material
        points = math.ceil((sum(machine.bodies.length) + BEYOND_M) / SPACING_M)
        # A bend each metre (20 cells) and two more, so that the interpolation has a value beyond either end.
        bends = rng.normal(0.0, UNEVENNESS_M, points // 20 + 2)
        uneven = np.interp(np.arange(points) / 20.0, np.arange(len(bends)), bends)
        # The origin is the boom foot, which stands above level ground.
        self.heights: Array = uneven - machine.chassis.boom_foot_height
        # Behind what one contact remembers: the depth of the rut at each point.
        self.memory: Array = np.zeros(at.MEMORY + points)
        self.numbers = terramechanics.pack_soil(material, machine, rng.uniform(*material.cone_index))
        self.tables = terramechanics.cutting_table(material)
        self.course = terramechanics.draw_course(material, rng)

    @property
    def payload_kg(self) -> float:
        """Soil in the bucket."""
        return float(self.memory[at.PAYLOAD])

    @property
    def ruts_m(self) -> Array:
        """Depth of the rut at each point of the profile, live."""
        return self.memory[at.MEMORY :]

    @property
    def mass_kg(self) -> float:
        """All soil: profile (above 0 of the boom-foot frame counts positive), heap before the edge, bucket."""
        profile = self.material.density * self.numbers[terramechanics.WIDTH] * SPACING_M * float(self.heights.sum())
        result: float = profile + float(self.memory[at.HEAP] + self.memory[at.PAYLOAD])
        return result

    def height(self, x: float) -> float:
        """Return the height (m above the boom foot) at a distance (m) in front of the boom foot."""
        return float(terramechanics.height_at(x - self.start_m, self.heights - self.ruts_m))

    def redraw(self, rng: np.random.Generator) -> None:
        """Redraw the resistance of soil not yet reached; soil at the cutting edge continues from its present value."""
        redraw_course(self.material, self.numbers, self.memory, self.course, rng)

    def arrays(self) -> tuple[Array, ...]:
        """Return the arrays of the compiled code: parameters, tables, resistance profile, heights, memory."""
        return self.numbers, self.tables, self.course, self.heights, self.memory


def no_ground() -> tuple[Array, ...]:
    """Stand-in of `Ground.arrays` in free air."""
    return np.zeros(terramechanics.NUMBERS), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2), np.zeros(at.MEMORY + 2)


def redraw_course(material: Material, numbers: Array, memory: Array, course: Array, rng: np.random.Generator) -> None:
    """Redraw the part of `course` not yet reached, in place; see `Ground.redraw`."""
    old = course.copy()
    fresh = terramechanics.draw_course(material, rng)
    count = len(old)
    # The unit process forgets its present value over a few cells: fresh[0] is independent, so it is bridged.
    here = int(memory[at.DISTANCE] / numbers[terramechanics.COURSE_STEP])
    keep = np.exp(-np.arange(count) / 8.0)
    ahead = (here + np.arange(count)) % count
    course[ahead, 0] = keep * old[here % count, 0] + np.sqrt(1.0 - keep**2) * fresh[:, 0]
    stone = (int(memory[at.DISTANCE] / terramechanics.STONE_STEP) + np.arange(count)) % count
    # A stone that the edge is in now stays until it has passed.
    inside = np.logical_and.accumulate(old[stone, 1] > 0.0)
    course[stone, 1] = np.where(inside, old[stone, 1], fresh[:, 1])
    # The strength of the present dig was already felt; that of the later ones was not.
    dig = int(memory[at.DIGS]) % count
    course[:, 2] = fresh[:, 2]
    course[dig, 2] = old[dig, 2]
