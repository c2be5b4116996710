"""Reader of ``modelDescription.xml`` of an FMU for co-simulation, versions 2.0 and 3.0, limited to plant models.

It may be a stranger's: document types, and with them entities, are refused, depth and counts are bounded, and nothing
outside of the bytes is opened.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from xml.parsers import expat

from edp.control.fmu.archive import DESCRIPTION
from edp.errors import DataError
from edp.storage.archives import printable

MAX_VARIABLES = 100_000
MAX_ELEMENTS = 1_000_000
"""Maximum number of XML elements. An element takes about 200 bytes of memory and at least four bytes of the file."""
DEEPEST = 50
"""Maximum nesting depth of XML elements. The standard needs 6 levels, tool annotations slightly more."""
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,127}")
"""Pattern of a C identifier. The model identifier becomes part of the path of the library."""
REFERENCE = re.compile(r"[0-9]{1,10}")
BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@dataclass(frozen=True)
class FmuVariable:
    """A variable of an FMU.

    Attributes:
        name: name given by the author of the FMU.
        reference: its value reference.
        causality: ``input``, ``output``, ``parameter``, ``local`` or another one.
        real: whether it is one double-precision number.
        unit: unit as stated; empty without one.
        bases: exponents of the base units, the factor and the offset of its unit, where it is defined.
    """

    name: str
    reference: int
    causality: str
    real: bool
    unit: str
    bases: Mapping[str, float] | None


@dataclass(frozen=True, eq=False)
class FmuDescription:
    """Properties of an FMU that a plant needs.

    Attributes:
        version: version of FMI, 2 or 3.
        token: GUID or instantiation token.
        identifier: name of its library.
        variables: variables by name.
        step_s: length of a step that it proposes or demands; None where it says nothing.
        any_step: whether it takes steps of any length.
        window: measured ticks that form the memory of an exported twin; 0 of other FMUs.
    """

    version: int
    token: str
    identifier: str
    variables: Mapping[str, FmuVariable]
    step_s: float | None
    any_step: bool
    window: int


def read_description(content: bytes, where: str) -> FmuDescription:
    """Read a description.

    Args:
        content: bytes of the XML file.
        where: the FMU, for messages.

    Raises:
        DataError: it is damaged, hostile, of another version, or not for co-simulation.
    """
    root = _tree(content, where)
    if root.tag != "fmiModelDescription":
        raise DataError(f"{where}: {DESCRIPTION} holds <{printable(root.tag)}>; fmiModelDescription must be its root")
    text = root.get("fmiVersion", "")
    if text[:2] not in ("2.", "3."):
        raise DataError(f"{where} is of FMI version '{printable(text)}'; 2.0 or 3.0 must hold")
    version = int(text[0])
    simulated = root.find("CoSimulation")
    if simulated is None:
        raise DataError(f"{where} is not for co-simulation; export it for co-simulation")
    if simulated.get("needsExecutionTool", "false") in ("true", "1"):
        raise DataError(f"{where} needs a tool of its author to run; export it with its solver inside")
    token = root.get("guid" if version == 2 else "instantiationToken", "")
    if not token or len(token) > 1000:
        raise DataError(f"{where} has no {'guid' if version == 2 else 'instantiationToken'}; export it again")
    identifier = simulated.get("modelIdentifier", "")
    if not IDENTIFIER.fullmatch(identifier):
        raise DataError(
            f"{where}: modelIdentifier '{printable(identifier)}' is not a name of a library; expected at most "
            "128 letters, digits and underscores"
        )
    experiment = root.find("DefaultExperiment")
    sizes = (simulated.get("fixedInternalStepSize"), None if experiment is None else experiment.get("stepSize"))
    step_s = next((_step(size, where) for size in sizes if size is not None), None)
    any_step = simulated.get("canHandleVariableCommunicationStepSize", "false") in ("true", "1")
    return FmuDescription(version, token, identifier, _variables(root, version, where), step_s, any_step, _window(root))


def _tree(content: bytes, where: str) -> ET.Element:
    """Parse the XML elements.

    Raises:
        DataError: it is not well-formed, has a document type, or is too deep.
    """
    builder, parser, depth, count = ET.TreeBuilder(), expat.ParserCreate(), [0], [0]

    def begin(tag: str, attributes: dict[str, str]) -> None:
        depth[0], count[0] = depth[0] + 1, count[0] + 1
        if depth[0] > DEEPEST or count[0] > MAX_ELEMENTS:
            raise DataError(
                f"{where}: elements of {DESCRIPTION} are more than {DEEPEST} deep or {MAX_ELEMENTS:,}; do not use "
                "this file"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        depth[0] -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise DataError(
            f"{where}: {DESCRIPTION} has a document type, which FMI does not need and entities could hide in; do not "
            "use this file"
        )

    # Entities can only be declared in a document type.
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    try:
        parser.Parse(content, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError, AssertionError) as error:
        raise DataError(
            f"{where}: {DESCRIPTION} is not well-formed XML ({printable(str(error))}); export it again"
        ) from error


def _step(text: str, where: str) -> float:
    try:
        step = float(text)
    except ValueError:
        step = math.nan
    if not 1e-6 <= step <= 1e6:
        raise DataError(f"{where}: stepSize '{printable(text)}'; a number of seconds above 0 must hold")
    return step


def _variables(root: ET.Element, version: int, where: str) -> dict[str, FmuVariable]:
    listed = root.find("ModelVariables")
    entries = [] if listed is None else list(listed)
    if len(entries) > MAX_VARIABLES:
        raise DataError(f"{where} has {len(entries):,} variables; at most {MAX_VARIABLES:,} are read")
    units, types = _units(root), _types(root, version)
    variables: dict[str, FmuVariable] = {}
    for entry in entries:
        name, reference = entry.get("name", ""), entry.get("valueReference", "")
        if not REFERENCE.fullmatch(reference) or int(reference) >= 1 << 32:
            raise DataError(
                f"{where}: variable '{printable(name)}' has valueReference '{printable(reference)}'; expected a "
                "whole number from 0 to 4294967295"
            )
        if name in variables:
            raise DataError(f"{where}: variable '{printable(name)}' stands twice; export it again")
        number = entry.find("Real") if version == 2 else entry
        # An array of FMI 3.0 is not one number.
        real = number is not None and (version == 2 or (entry.tag == "Float64" and entry.find("Dimension") is None))
        unit = "" if number is None else number.get("unit", types.get(number.get("declaredType", ""), ""))
        variables[name] = FmuVariable(
            name, int(reference), entry.get("causality", "local"), real, unit, units.get(unit)
        )
    return variables


def _units(root: ET.Element) -> dict[str, dict[str, float]]:
    """Return the base units by unit, with ``factor`` and ``offset``; non-numeric entries are omitted."""
    units: dict[str, dict[str, float]] = {}
    for unit in root.iterfind("UnitDefinitions/Unit"):
        base = unit.find("BaseUnit")
        if base is None:
            continue
        try:
            exponents = {name: float(base.get(name, "0")) for name in BASES}
            scale = {"factor": float(base.get("factor", "1")), "offset": float(base.get("offset", "0"))}
        except ValueError:
            continue
        units[unit.get("name", "")] = exponents | scale
    return units


def _types(root: ET.Element, version: int) -> dict[str, str]:
    """Return the units of declared types, by name."""
    if version == 3:
        return {kind.get("name", ""): kind.get("unit", "") for kind in root.iterfind("TypeDefinitions/Float64Type")}
    pairs = ((kind, kind.find("Real")) for kind in root.iterfind("TypeDefinitions/SimpleType"))
    return {kind.get("name", ""): real.get("unit", "") for kind, real in pairs if real is not None}


def _window(root: ET.Element) -> int:
    """Return the measured ticks of an exported twin, by its annotation."""
    for note in (*root.iterfind("VendorAnnotations/Tool/edp"), *root.iterfind("Annotations/Annotation/edp")):
        text = note.get("window", "")
        if REFERENCE.fullmatch(text):
            # Beyond a minute of any rate it is no memory of a machine.
            return min(int(text), 60_000)
    return 0
