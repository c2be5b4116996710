"""Every registered layer, fault, twin and log format has the places that docs/howto/add_part.md lists."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from edp.export.c.calls import CALLS
from edp.export.c.tangents import TANGENTS
from edp.export.onnx.step import KINDS
from edp.export.simulink.native import WRITERS
from edp.ir import Layer
from edp.ir.kinds import FLOAT_KINDS
from edp.ir.layers import BinaryOperation, Elementwise
from edp.logs import FORMATS
from edp.networks.twin import TWINS
from edp.sim.faults.base import FAULTS, MachineFault, SensorFault

ROOT = Path(__file__).parents[2]
MOST = 6
"""Places that adding one part may touch."""
Check = Callable[[str, object], bool]
"""(name, part) to whether the part has this place."""


def text(path):
    return (ROOT / path).read_text(encoding="utf-8")


def in_casadi(name, kind):
    words = [f'"{operation.capitalize()}"' for operation in BinaryOperation] if kind is Elementwise else [f'"{name}"']
    return all(f"    {word}: " in text("src/edp/export/casadi/runtime.py") for word in words)


def in_file_of(folder):
    """Return whether a class stands in a file of the folder."""

    def check(name, part):
        kind = part if isinstance(part, type) else type(part)
        return kind.__module__.startswith(folder.replace("/", ".") + ".")

    return check


def imported_in(path):
    """Return whether a package imports the module of a class."""

    def check(name, part):
        kind = part if isinstance(part, type) else type(part)
        return re.search(rf"\b{kind.__module__.rpartition('.')[2]}\b", text(path)) is not None

    return check


def fault_registered(name, part):
    file = "sensor_faults" if isinstance(part, SensorFault) else "machine_faults"
    return f'FAULTS.register("{name}")' in text(f"src/edp/sim/faults/{file}.py")


PLACES: dict[str, dict[str, Check]] = {
    "Add a layer": {
        "src/edp/ir/layers.py": lambda name, kind: kind.over_time is not Layer.over_time,
        "src/edp/export/c/calls.py": lambda name, kind: kind in CALLS,
        "src/edp/export/c/tangents.py": lambda name, kind: kind in TANGENTS or "tangent" in kind.without,
        "src/edp/export/onnx/plain.py": lambda name, kind: kind in KINDS or "onnx" in kind.without,
        "src/edp/export/simulink/native.py": lambda name, kind: kind in WRITERS or "matlab" in kind.without,
        "src/edp/export/casadi/runtime.py": in_casadi,
    },
    "Add a log format": {
        "src/edp/logs/formats/NAME.py": in_file_of("edp/logs/formats"),
        "src/edp/logs/__init__.py": imported_in("src/edp/logs/__init__.py"),
    },
    "Add a fault": {
        "src/edp/sim/faults/machine_faults.py": fault_registered,
    },
    "Add a twin": {
        "src/edp/networks/twin/NAME.py": in_file_of("edp/networks/twin"),
        "src/edp/networks/twin/__init__.py": imported_in("src/edp/networks/twin/__init__.py"),
    },
}


def parts_of(section):
    """Every registered part of the kind of a section, by name."""
    return {
        "Add a layer": {kind.__name__: kind for kind in FLOAT_KINDS},
        "Add a log format": FORMATS,
        "Add a fault": FAULTS,
        "Add a twin": TWINS,
    }[section]


def lacking(section):
    """The places that were forgotten, by part."""
    missing = {
        name: [place for place, check in PLACES[section].items() if not check(name, part)]
        for name, part in parts_of(section).items()
    }
    return {name: places for name, places in missing.items() if places}


def listed(section):
    """First path of each numbered item of a section of the page."""
    (body,) = re.findall(rf"^## {section}\n(.*?)(?=^## )", text("docs/howto/add_part.md"), re.MULTILINE | re.DOTALL)
    return [re.search(r"`([^`]*[/.][^`]*)`", item)[1] for item in re.findall(r"^\d\. (.*)$", body, re.MULTILINE)]


@pytest.mark.parametrize("section", list(PLACES))
def test_no_part_lacks_a_place(section):
    assert lacking(section) == {}


@pytest.mark.parametrize("section", list(PLACES))
def test_the_page_lists_the_places_that_are_checked(section):
    assert listed(section) == list(PLACES[section])
    assert len(PLACES[section]) <= MOST


class Strange(Layer):
    """A layer without any place."""

    @property
    def width(self):
        return 1


@dataclass(frozen=True)
class StrangeTwin:
    """A formulation without any place."""


def test_a_layer_without_places_names_them_all(monkeypatch):
    monkeypatch.setitem(globals(), "FLOAT_KINDS", FLOAT_KINDS | {Strange})
    assert lacking("Add a layer") == {"Strange": list(PLACES["Add a layer"])}
    monkeypatch.setattr(Strange, "over_time", lambda self, run: None)
    monkeypatch.setitem(CALLS, Strange, lambda calls, layer: [])
    monkeypatch.setattr(Strange, "without", {"tangent": "do without", "matlab": "do without"})
    assert lacking("Add a layer") == {
        "Strange": ["src/edp/export/onnx/plain.py", "src/edp/export/casadi/runtime.py"],
    }


def test_a_twin_without_places_names_them_all(monkeypatch):
    monkeypatch.setitem(TWINS._parts, "strange", StrangeTwin)
    assert lacking("Add a twin") == {"strange": list(PLACES["Add a twin"])}


def test_a_log_format_without_places_names_them_all(monkeypatch):
    strange = SimpleNamespace(name="strange", suffixes=(".csv", ".strange"))
    monkeypatch.setitem(FORMATS._parts, "strange", strange)
    assert lacking("Add a log format") == {"strange": list(PLACES["Add a log format"])}


@pytest.mark.parametrize("kind", [MachineFault, SensorFault])
def test_a_fault_without_places_names_them_all(kind, monkeypatch):
    monkeypatch.setitem(FAULTS._parts, "strange", object.__new__(kind))
    assert lacking("Add a fault") == {"strange": list(PLACES["Add a fault"])}
