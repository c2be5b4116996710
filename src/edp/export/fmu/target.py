"""``--to fmu``: a predictor as units of FMI 2.0 and 3.0 for co-simulation."""

from __future__ import annotations

import hashlib
import io
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from edp.errors import ExportError
from edp.export.base import TARGETS
from edp.export.c.model import Model, make_model
from edp.export.c.tangents import differentiable
from edp.export.c.target import check_name, core_files
from edp.export.description import Description, as_json
from edp.export.escape import Code, c_string, fill, visible
from edp.export.fmu.build import PLATFORMS, Sources, libraries
from edp.export.fmu.describe import About, build_description, fmi2, fmi3
from edp.export.fmu.interface import Variable, variables
from edp.export.fmu.page import page
from edp.export.folder import write_export
from edp.networks.integer import IntegerPredictor
from edp.training.bundle import Bundle

COMMON = ("edp_fmu.h", "edp_fmu.c")
OWN: Mapping[int, tuple[str, ...]] = {
    2: ("edp_fmi2.h", "edp_fmi2.c"),
    3: ("edp_fmi3.h", "edp_fmi3.c", "edp_fmi3_absent.c"),
}
"""Files of the plumbing by version of FMI."""
VERSIONS = {"2": (2,), "3": (3,), "both": (2, 3)}
BINARIES = {"both": tuple(PLATFORMS), **{name: (name,) for name in PLATFORMS}, "none": ()}
TANGENT = """
#include "{0}_tangent.h"
#define FMU_TANGENT {0}_tangent
#define FMU_TANGENT_RESET {0}_tangent_reset
#define FMU_STEP_TANGENT {0}_step_tangent
"""
# The earliest date that a ZIP file can hold.
DATE = (1980, 1, 1, 0, 0, 0)
"""Of every file in an FMU, so that the same network gives the same bytes."""


@TARGETS.register("fmu")
@dataclass(frozen=True)
class FmuTarget:
    """FMI 2.0 and 3.0 for co-simulation, float32 or w8a16: ``NAME_fmi2.fmu`` and ``NAME_fmi3.fmu``.

    Attributes:
        version: of FMI: 2, 3 or both.
        binaries: shared libraries beside the sources: linux64, win64, both or none.
        derivatives: with directional derivatives, float32 only and not of grey boxes; a second copy of the weights is
            in the code for them.
    """

    version: str = "both"
    binaries: str = "both"
    derivatives: bool = True

    def __post_init__(self) -> None:
        if self.binaries not in BINARIES:
            raise ExportError(f"binaries '{self.binaries}' are not built; choose one of {', '.join(BINARIES)}")
        if self.version not in VERSIONS:
            raise ExportError(f"FMI version '{self.version}' is not written; choose one of {', '.join(VERSIONS)}")

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        tangent = self.derivatives and _differentiable(bundle)
        model, versions = make_model(name, bundle, tangent), VERSIONS[self.version]
        listed = variables(model)
        core, plumbing = core_files(model), _plumbing(*COMMON, *(file for v in versions for file in OWN[v]))
        about = _about(model, listed, core)
        core["fmu_model.h"] = _header(model, about)
        common = _c_files((*core, *COMMON))
        own = {version: _c_files(OWN[version]) for version in versions}
        built = libraries(Sources(name, core | plumbing, common, own), BINARIES[self.binaries])
        files = {}
        for version in versions:
            # Only the plumbing of its own version: two sets of entry points would clash in one library.
            sources = core | {file: plumbing[file] for file in (*COMMON, *OWN[version])}
            content = _files(version, about, sources, Description(name, bundle, model.graph))
            files[f"{name}_fmi{version}.fmu"] = _packed(content | built[version])
        return write_export(folder, files)


def _differentiable(bundle: Bundle) -> bool:
    """Whether directional derivatives can be given: a staircase of integers has none, nor a grey box's C code."""
    return not isinstance(bundle.predictor, IntegerPredictor) and differentiable(bundle.predictor.graph())


def _files(version: int, about: About, sources: Mapping[str, str], described: Description) -> dict[str, bytes]:
    """Content of an FMU without libraries, by path."""
    compiled = _c_files(sources)
    files = {"modelDescription.xml": fmi2(about, compiled) if version == 2 else fmi3(about)}
    files["documentation/index.html"] = page(about)
    files[f"resources/{about.name}.json"] = as_json(described.content())
    files |= {f"sources/{file}": text.encode() for file, text in sources.items()}
    if version == 3:
        files["sources/buildDescription.xml"] = build_description(about, compiled)
    return files


def _about(model: Model, listed: list[Variable], core: Mapping[str, str]) -> About:
    """What the XML files tell; the token is that of the sources and of the variables."""
    described = Description(model.name, model.bundle, model.graph).content()
    state = hashlib.blake2b(digest_size=16)
    # Everything that decides behaviour or interface is in the token: another FMU has another one.
    for text in (*core.values(), *_plumbing(*COMMON, *OWN[2], *OWN[3]).values(), repr(listed)):
        # The zero byte separates texts: two files cannot be shifted into one another.
        state.update(text.encode() + b"\0")
    keys = ("model_hash", "scale_hash", "number_format", "window", "mode")
    facts = {key: str(described[key]) for key in keys}
    if model.graph.fed_back:
        facts["plant"] = f"{model.bundle.predictor.required} commands"
    facts["horizons_ticks"] = " ".join(map(str, model.bundle.task.horizons))
    token = "{" + str(uuid.UUID(bytes=state.digest())) + "}"
    return About(
        model.name, token, visible(described["network"]), described["rate_hz"], listed, model.changes is not None, facts
    )


def _header(model: Model, about: About) -> str:
    """What binds the plumbing to the model."""
    text = resources.files("edp.export.fmu").joinpath("templates/fmu_model.h.in").read_text()
    names = Code(", ".join(c_string(entry.name) for entry in about.listed if entry.causality == "input"))
    values: dict[str, object] = {"name": model.name, "NAME": model.name.upper(), "token": Code(about.token)}
    values["required"] = model.bundle.predictor.required
    values |= {"rate": repr(about.rate_hz), "step": repr(about.step_s), "names": names}
    values["tangent"] = Code(TANGENT.format(model.name)) if about.derivatives else ""
    return fill(text, values)


def _plumbing(*names: str) -> dict[str, str]:
    return {name: resources.files("edp.export.fmu").joinpath(f"plumbing/{name}").read_text() for name in names}


def _c_files(names: Mapping[str, str] | tuple[str, ...]) -> list[str]:
    return [name for name in names if name.endswith(".c")]


def _packed(content: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in content.items():
            entry = zipfile.ZipInfo(path, DATE)
            # Executable rights and Unix origin: without them the libraries cannot be loaded after unpacking on Linux.
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o755 << 16
            entry.create_system = 3
            archive.writestr(entry, data)
    return buffer.getvalue()
