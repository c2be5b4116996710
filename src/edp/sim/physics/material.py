"""Materials of soil, read from `materials/<name>.toml`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

from edp.errors import ConfigError, closest
from edp.settings.bounds import above, check_bounds, span
from edp.settings.tree import SettingsTree
from edp.storage import SETTINGS_BYTES, parse_toml, read_text
from edp.wording import setting_text, typed

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
"""Bounds of the parameters of a material. The softest mud has a cone index of some kPa; rock has no cone index."""


@dataclass(frozen=True)
class Material:
    """One soil; SI units, angles in degrees. Each ground has a random `cone_index` within its range.

    Attributes:
        density: density in the bank, kg/m^3.
        bekker_exponent: n of p = (k_c / b + k_phi) z^n.
        shear_length: Janosi's shear deformation modulus K, m.
        swell: ratio of loose volume to bank volume.
        roughness: standard deviation of the logarithm of the resistance along the path.
        roughness_length: correlation length of the resistance, m.
        sawtooth: fraction of the resistance that is lost when a chip breaks off.
        compaction: fraction of the heel's permanent sinkage, up to 0.1 m, that remains as a rut after the heel has
            left.
        back_push: fraction of the soil in front of the bucket's back that the bucket pushes ahead; the rest flows
            around the bucket and stays behind it. With 0, the back meets resistance and does not move soil.
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
    """Return the names of the materials that come with the package."""
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
