"""``modelDescription.xml`` for both versions of FMI, and the files that accompany the sources."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

from edp import __version__
from edp.export.fmu.interface import Variable
from edp.export.fmu.units import BASES, shown, units_of

# 500 ticks are 5 s at 100 Hz: several windows, and done at once.
EXPERIMENT_TICKS = 500
"""Number of samples of the default experiment."""
CATEGORIES = {
    "logStatusWarning": "bad or missing inputs, ticks left out",
    "logStatusError": "calls that are refused, with the reason",
}
# The flags of an importer that compiles itself must not fuse products and sums either.
OPTIONS = "-O2 -ffp-contract=off"
FORMS2 = {"real": "Real", "whole": "Integer", "flag": "Boolean"}
FORMS3 = {"real": "Float64", "whole": "Int32", "flag": "Boolean"}


@dataclass(frozen=True, eq=False)
class About:
    """Content of the XML files.

    Attributes:
        name: name of the model and its binaries.
        token: content address of sources and interface, in the form of a GUID.
        title: the network in a line.
        rate_hz: sampling rate in Hz.
        listed: variables in the order of their value references.
        derivatives: whether directional derivatives are provided.
        facts: further properties by name.
    """

    name: str
    token: str
    title: str
    rate_hz: float
    listed: Sequence[Variable]
    derivatives: bool
    facts: dict[str, str]

    @property
    def step_s(self) -> float:
        """Length of a tick."""
        return 1.0 / self.rate_hz


def fmi2(about: About, sources: Sequence[str]) -> bytes:
    """Return the description for FMI 2.0; `sources` are the C files to compile."""
    root = ET.Element("fmiModelDescription", {"fmiVersion": "2.0"} | _head(about) | {"guid": about.token})
    abilities = _abilities("canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative", about)
    more = {"canNotUseMemoryManagementFunctions": "true", "canInterpolateInputs": "false"}
    simulated = ET.SubElement(root, "CoSimulation", {"modelIdentifier": about.name} | abilities | more)
    files = ET.SubElement(simulated, "SourceFiles")
    for file in sources:
        ET.SubElement(files, "File", {"name": file})
    _units(root, about)
    _categories(root)
    _experiment(root, about)
    tool = ET.SubElement(ET.SubElement(root, "VendorAnnotations"), "Tool", {"name": "EDP"})
    ET.SubElement(tool, "edp", about.facts)
    listed = ET.SubElement(root, "ModelVariables")
    for reference, entry in enumerate(about.listed):
        element = ET.SubElement(listed, "ScalarVariable", _common(reference, entry))
        ET.SubElement(element, FORMS2[entry.form], _numbers(entry))
    structure = ET.SubElement(root, "ModelStructure")
    for kind in ("Outputs", "InitialUnknowns"):
        group = ET.SubElement(structure, kind)
        for reference in _outputs(about):
            ET.SubElement(group, "Unknown", {"index": str(reference + 1), "dependencies": ""})
    return _text(root)


def fmi3(about: About) -> bytes:
    """Return the description for FMI 3.0."""
    root = ET.Element("fmiModelDescription", {"fmiVersion": "3.0"} | _head(about) | {"instantiationToken": about.token})
    abilities = _abilities("canGetAndSetFMUState", "canSerializeFMUState", "providesDirectionalDerivatives", about)
    more = {"fixedInternalStepSize": repr(about.step_s)}
    ET.SubElement(root, "CoSimulation", {"modelIdentifier": about.name} | abilities | more)
    _units(root, about)
    _categories(root)
    _experiment(root, about)
    # FMI 2.0 counts unknowns from 1, value references from 0.
    listed = ET.SubElement(root, "ModelVariables")
    for reference, entry in enumerate(about.listed):
        ET.SubElement(listed, FORMS3[entry.form], _common(reference, entry) | _numbers(entry))
    # Time is a variable in FMI 3.0; its name must not be one of the network's channels.
    time = {"name": _time(about), "valueReference": str(len(about.listed)), "causality": "independent"}
    ET.SubElement(listed, "Float64", time | {"variability": "continuous", "unit": "s", "description": "time"})
    structure = ET.SubElement(root, "ModelStructure")
    for kind in ("Output", "InitialUnknown"):
        for reference in _outputs(about):
            ET.SubElement(structure, kind, {"valueReference": str(reference), "dependencies": ""})
    note = ET.SubElement(ET.SubElement(root, "Annotations"), "Annotation", {"type": "excavator-dynamics-predictor"})
    ET.SubElement(note, "edp", about.facts)
    return _text(root)


def build_description(about: About, sources: Sequence[str]) -> bytes:
    """Return ``sources/buildDescription.xml`` of FMI 3.0."""
    root = ET.Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    configuration = ET.SubElement(root, "BuildConfiguration", {"modelIdentifier": about.name})
    files = ET.SubElement(
        configuration, "SourceFileSet", {"language": "C99", "compiler": "gcc", "compilerOptions": OPTIONS}
    )
    for file in sources:
        ET.SubElement(files, "SourceFile", {"name": file})
    ET.SubElement(configuration, "Library", {"name": "m", "external": "true", "description": "the C library's"})
    return _text(root)


def _head(about: About) -> dict[str, str]:
    return {
        "modelName": about.name,
        "description": about.title,
        "generationTool": f"Excavator Dynamics Predictor {__version__}",
        "variableNamingConvention": "flat",
    }


def _abilities(state: str, serial: str, derivative: str, about: About) -> dict[str, str]:
    """Return the capability flags of both versions, under their names."""
    return {
        "needsExecutionTool": "false",
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canHandleVariableCommunicationStepSize": "false",
        state: "true",
        serial: "true",
        derivative: "true" if about.derivatives else "false",
    }


def _units(root: ET.Element, about: About) -> None:
    group = ET.SubElement(root, "UnitDefinitions")
    for name, displays in units_of([entry.kind for entry in about.listed if entry.form == "real"]).items():
        unit = ET.SubElement(group, "Unit", {"name": name})
        ET.SubElement(unit, "BaseUnit", {base: str(power) for base, power in BASES[name].items()})
        for also in displays:
            facts = {"name": also.name, "factor": repr(also.factor)}
            ET.SubElement(unit, "DisplayUnit", facts | ({"offset": repr(also.offset)} if also.offset else {}))


def _categories(root: ET.Element) -> None:
    group = ET.SubElement(root, "LogCategories")
    for name, text in CATEGORIES.items():
        ET.SubElement(group, "Category", {"name": name, "description": text})


def _experiment(root: ET.Element, about: About) -> None:
    stop = repr(EXPERIMENT_TICKS / about.rate_hz)
    ET.SubElement(root, "DefaultExperiment", {"startTime": "0.0", "stopTime": stop, "stepSize": repr(about.step_s)})


def _common(reference: int, entry: Variable) -> dict[str, str]:
    attributes = {"name": entry.name, "valueReference": str(reference)}
    if entry.description:
        attributes["description"] = entry.description
    attributes |= {"causality": entry.causality, "variability": "continuous" if entry.form == "real" else "discrete"}
    # An input has a start value; everything else is calculated.
    return attributes if entry.causality == "input" else attributes | {"initial": "calculated"}


def _numbers(entry: Variable) -> dict[str, str]:
    if entry.form != "real":
        return {}
    attributes = {"unit": entry.unit}
    also = shown(entry.kind)
    attributes |= {"displayUnit": also.name} if also is not None else {}
    attributes["nominal"] = repr(entry.nominal)
    # A start of zero is required of inputs; the unit counts ticks as bad until the importer sets them.
    return attributes | ({"start": "0.0"} if entry.causality == "input" else {})


def _time(about: About) -> str:
    names = {entry.name for entry in about.listed}
    return next(name for k in range(len(names) + 1) if (name := f"time_{k}" if k else "time") not in names)


def _outputs(about: About) -> list[int]:
    return [reference for reference, entry in enumerate(about.listed) if entry.causality == "output"]


def _text(root: ET.Element) -> bytes:
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode").encode() + b"\n"
