"""Every number of every table that EDP reads as settings has bounds; the tables are found in the source."""

import ast
import dataclasses
import importlib
import inspect
import math
import pkgutil
import sys
import tomllib
import typing
from importlib import resources
from pathlib import Path

import pytest

import edp
from edp.config.experiment import SETTINGS
from edp.errors import ConfigError
from edp.settings.tree import SettingsTree
from edp.sim.data_set import SimulationOrder
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_checks import MACHINE_FILE, check_machine
from edp.sim.physics.material import MATERIAL_FILE, Material
from edp.sim.scenario_file import ScenarioFile

SLIPS = (-1e26, 1e308, math.nan, math.inf, -math.inf, 10**18)
"""Numbers that no setting takes."""
SUSPECT = (-1, 0, 1e-320)
"""Numbers that a setting may take; building with them must end in a spec or one message."""
TAKEN = {
    ("ScenarioFile", "seed"): {10**18},  # 63 bits
    ("AdamW", "learning_rate"): {10**18},
    ("Discriminative", "learning_rate"): {10**18},
    ("Sgd", "learning_rate"): {10**18},
    ("Soap", "learning_rate"): {10**18},  # up to what float32 holds; a training that diverges says so
    ("SearchSpec", "elastic"): {10**18},
    ("MetaSpec", "inner_learning_rate"): {10**18},
    **{("FinetuneSpec", f"{name}learning_rate"): {10**18} for name in ("backbone_", "head_", "inner_", "")},
    ("RecordingEntry", "rows"): {10**18},  # compared with the rows of the log
    **{("RowsFile", name): {10**18} for name in ("bytes", "changed_ns", "written_ns")},  # of the file system
    **{("ChannelMap", name): {10**18, -1e26} for name in ("constant", "scale")},  # any unit
    **{("Real", name): {*SLIPS} - {math.nan} for name in ("low", "high")},  # the setting that is searched has bounds
    ("StoreIndex", "schema"): {10**18},  # a version: the reader of the index compares it
}
"""By table and key: the slips that are taken, and why."""
EXAMPLES = {
    "TrialsSpec": {"trials": 24},
    "FeatureSettings": {"channels": ["a"]},
    "RefusedLog": {"log": "a.csv", "why": "b"},
    "Channel": {"name": "a", "kind": "pressure"},
    "LagElement": {"name": "a", "command": "b", "pressure": "c"},
    "MassElement": {"name": "a", "command": "b", "velocity": "c"},
    "TankElement": {"name": "a", "source": "b"},
    "DistilSpec": {"units": 4},
    "Session": {"name": "a", "digest": "b"},
    "PumpElement": {"name": "a"},
    "ValveElement": {"name": "a", "actuator": "b", "extend": "c"},
    "Derived": {"name": "a", "source": "b"},
    "RecordingEntry": {"path": "a.csv"},
    "RowsFile": {"key": "a"},
    "WatchSpec": {"detector": {"kind": "ewma"}},
    "CylinderElement": {"name": "a", "velocity": "v"},
    "MotorElement": {"name": "a", "velocity": "v"},
    "ChannelMap": {"name": "a", "column": "b"},
    "Choice": {"options": ["a", "b"]},
    "Real": {"low": 0.1, "high": 1.0},
}
"""Keys that a table cannot do without."""
ELSEWHERE = {
    "StoreEntry": "tests/security/test_hostile_stores.py changes every number of an index",
    "FaultSpec": "tests/unit/sim tests the notation of faults",
    "ScenarioChanges": "its values are checked with those of the file: test_changes_of_a_scenario",
    "TaskSpec": "abstract",
    "_Form": "the content of twin.json; its parts are tables of their own",
}


RESULTS = {
    "edp.evaluation.compression": "figures of compression.json",
    "edp.evaluation.controller.ResourceUsage": "a figure of compression.json and study.json",
    "edp.evaluation.study": "figures of study.json",
    "edp.evaluation.study_facts": "figures of study.json",
    "edp.storage.ledger.store.Opening": "a record of study.json",
    "edp.workflows.compression.pipeline": "figures of study.json",
    "edp.workflows.search.smaller": "requests of a search to its workers",
    "edp.workflows.search.trainings": "requests of a search to its workers",
}
"""Modules, or classes, whose tables EDP writes for itself: types are checked, a range would say nothing."""


def is_result(kind):
    return kind.__module__ in RESULTS or f"{kind.__module__}.{kind.__name__}" in RESULTS


def modules():
    """All modules of EDP that can be imported here."""
    for found in pkgutil.walk_packages(edp.__path__, "edp."):
        if not found.name.endswith("__main__"):
            try:
                importlib.import_module(found.name)
            except ModuleNotFoundError as missing:
                if (missing.name or "edp").startswith("edp"):
                    raise
    return {name: module for name, module in sys.modules.items() if name == "edp" or name.startswith("edp.")}


def inner(hint):
    yield hint
    for part in typing.get_args(hint):
        yield from inner(part)


def read_as_settings():
    """Dataclasses that a settings tree builds: roots named in calls, registered parts, and what these hold."""
    known, found = modules(), {}
    trees = {
        id(value): value
        for module in known.values()
        for value in vars(module).values()
        if isinstance(value, SettingsTree)
    }
    classes = {
        value.__name__: value
        for module in known.values()
        for value in vars(module).values()
        if isinstance(value, type) and dataclasses.is_dataclass(value)
    }
    todo = [kind for tree in trees.values() for registry in tree.parts.values() for kind in registry.values()]
    for module in known.values():
        source = getattr(module, "__file__", None)
        for call in ast.walk(ast.parse(Path(source).read_text(encoding="utf-8"))) if source else ():
            if isinstance(call, ast.Call) and ast.unparse(call.func).rpartition(".")[2] in (
                "build",
                "load",
                "command_settings",
            ):
                # Commands import inside their functions, so names are looked up everywhere.
                named = [
                    classes[part.id] for part in call.args[:2] if isinstance(part, ast.Name) and part.id in classes
                ]
                todo += named
    while todo:
        kind = todo.pop()
        if kind not in found:
            found[kind] = typing.get_type_hints(kind)
            parts = (part for hint in found[kind].values() for part in inner(hint))
            todo += [part for part in parts if isinstance(part, type) and dataclasses.is_dataclass(part)]
    return found, SettingsTree({name: parts for tree in trees.values() for name, parts in tree.parts.items()})


TABLES, TREE = read_as_settings()
PHYSICAL = {Machine, Material}
"""Files of many required numbers; each number of a shipped file is changed in turn."""


def below(kind):
    found = {kind}
    for hint in TABLES.get(kind, {}).values():
        for part in inner(hint):
            if part in TABLES and part not in found:
                found |= below(part)
    return found


APART = set().union(*map(below, PHYSICAL))
TESTED = [
    kind
    for kind in TABLES
    if kind not in APART and kind.__name__ not in ELSEWHERE and not inspect.isabstract(kind) and not is_result(kind)
]
NUMBERS = sorted(
    {
        (kind, name)
        for kind in TESTED
        for name, hint in TABLES[kind].items()
        if name in {entry.name for entry in dataclasses.fields(kind) if entry.init} and {int, float} & set(inner(hint))
    },
    key=lambda case: (case[0].__module__, case[0].__qualname__, case[1]),
)


def forms(value):
    """A number as it may stand in a table: alone, in a list, by name."""
    return value, [value], [value, value], [value] * 3, [[value, value]], {"a": value}


def take(kind, name, value):
    """Whether a table takes a number in any form; nothing but one message may refuse it."""
    taken = False
    for form in forms(value):
        try:
            spec = TREE.build(kind, EXAMPLES.get(kind.__name__, {}) | {name: form}, "here")
            getattr(spec, "check", lambda: None)()  # what a table of others calls for its parts
        except ConfigError:
            continue
        taken = True
    return taken


def test_tables_of_all_commands_are_found():
    names = {kind.__name__ for kind in TABLES}
    assert {
        "Experiment",
        "TwinExperiment",
        "MonitorExperiment",
        "ControlExperiment",
        "SearchSpec",
        "FinetuneSpec",
    } <= names
    assert {"CompressionSearchSpec", "ScenarioFile", "MetaSpec", "JudgeSpec", "Machine", "Material"} <= names
    assert len(NUMBERS) > 400


@pytest.mark.parametrize("kind", TESTED, ids=lambda kind: kind.__qualname__)
def test_a_table_can_be_built_or_has_an_example(kind):
    """Else each number of it would be refused for what is missing, and nothing tested."""
    TREE.build(kind, EXAMPLES.get(kind.__name__, {}), "here")


@pytest.mark.parametrize(("kind", "name"), NUMBERS, ids=lambda case: getattr(case, "__qualname__", case))
def test_numbers_outside_any_range_are_refused(kind, name):
    taken = {value for value in SLIPS if take(kind, name, value)}
    assert taken <= TAKEN.get((kind.__name__, name), set())
    for value in SUSPECT:
        take(kind, name, value)


def leaves(table, path=()):
    """Paths of the numbers of a nested table."""
    items = table.items() if isinstance(table, dict) else enumerate(table)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*path, key)


def changed(table, path, value):
    if not path:
        return value
    copy = dict(table) if isinstance(table, dict) else list(table)
    copy[path[0]] = changed(table[path[0]], path[1:], value)
    return copy


def shipped(folder, name):
    return tomllib.loads((resources.files("edp.sim") / folder / name).read_text(encoding="utf-8"))


def build_machine(table):
    check_machine(MACHINE_FILE.build(Machine, table, "here"), "here")


def build_material(table):
    MATERIAL_FILE.build(Material, table, "here")


@pytest.mark.long
@pytest.mark.parametrize(
    ("build", "folder", "name"),
    [(build_machine, "machines", "m22.toml"), (build_material, "materials", "clay.toml")],
)
def test_numbers_of_machines_and_soils_have_bounds(build, folder, name):
    table, taken = shipped(folder, name), []
    for path in leaves(table):
        for value in (*SLIPS, *SUSPECT):
            try:
                build(changed(table, path, value))
            except ConfigError:
                continue
            taken += [(path, value)] if value in SLIPS or math.isnan(value) else []
    assert [case for case in taken if case != (("sensors", "instance_seed"), 10**18)] == []


@pytest.mark.parametrize("name", [name for kind, name in NUMBERS if kind is ScenarioFile])
def test_changes_of_a_scenario(name):
    """`edp simulate --set`: the same bounds as in the file."""
    for value in SLIPS:
        if value not in TAKEN.get(("ScenarioFile", name), set()):
            with pytest.raises(ConfigError):
                SimulationOrder.from_scenario(None, print, [f"{name}={value}"])


def test_trees_share_the_parts_of_networks():
    assert {"backbone", "head", "output"} <= set(SETTINGS.parts)
    assert set(SETTINGS.parts) <= set(TREE.parts)
