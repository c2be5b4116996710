"""``--format fmu``: a predictor as units of FMI 2.0 and 3.0 for co-simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from edp.export.base import TARGETS
from edp.export.c.model import Model, make_model
from edp.export.c.tangents import differentiable
from edp.export.c.target import check_name, core_files
from edp.export.description import Description, as_json
from edp.export.escape import visible
from edp.export.fmu.assemble import check_choice, fmu_files, model_header, token_of
from edp.export.fmu.describe import About
from edp.export.fmu.interface import Variable, variables
from edp.export.folder import write_export
from edp.networks.integer import IntegerPredictor
from edp.training.bundle import Bundle

TANGENT = """
#include "{0}_tangent.h"
#define FMU_TANGENT {0}_tangent
#define FMU_TANGENT_RESET {0}_tangent_reset
#define FMU_STEP_TANGENT {0}_step_tangent
"""


@TARGETS.register("fmu")
@dataclass(frozen=True)
class FmuTarget:
    """FMI 2.0 and 3.0 for co-simulation, float32 or w8a16: ``NAME_fmi2.fmu`` and ``NAME_fmi3.fmu``.

    Attributes:
        version: version of FMI: 2, 3 or both.
        binaries: shared libraries beside the sources: linux64, win64, both or none.
        derivatives: whether to include directional derivatives, float32 only and not for grey boxes; the code then
            contains the weights twice.
    """

    version: str = "both"
    binaries: str = "both"
    derivatives: bool = True

    def __post_init__(self) -> None:
        check_choice(self.version, self.binaries)

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        tangent = self.derivatives and _differentiable(bundle)
        model = make_model(name, bundle, tangent)
        core = core_files(model)
        about = _describe(model, variables(model), core)
        macros = TANGENT.format(name) if about.derivatives else ""
        core["fmu_model.h"] = model_header(about, bundle.predictor.required, macros)
        described = as_json(Description(name, bundle, model.graph).content())
        return write_export(folder, fmu_files(about, core, described, self.version, self.binaries))


def _differentiable(bundle: Bundle) -> bool:
    """Return whether directional derivatives exist: not for integer networks, nor for the C code of a grey box."""
    return not isinstance(bundle.predictor, IntegerPredictor) and differentiable(bundle.predictor.graph())


def _describe(model: Model, listed: list[Variable], core: Mapping[str, str]) -> About:
    """Return the content of the XML files with a token computed from sources and variables."""
    described = Description(model.name, model.bundle, model.graph).content()
    keys = ("model_hash", "scale_hash", "number_format", "window", "mode")
    facts = {key: str(described[key]) for key in keys}
    if model.graph.fed_back:
        facts["plant"] = f"{model.bundle.predictor.required} commands"
    facts["horizons_ticks"] = " ".join(map(str, model.bundle.task.horizons))
    token = token_of((*core.values(), repr(listed)))
    return About(
        model.name, token, visible(described["network"]), described["rate_hz"], listed, model.changes is not None, facts
    )
