"""Whether a setting that a page names with ``--set`` exists: keys are followed through the specs of the commands."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import Any

from edp.cli.names import FOCUS, SIMULATION
from edp.config.control import CONTROL_SETTINGS, ControlExperiment
from edp.config.experiment import SETTINGS, Experiment
from edp.config.monitor import MONITOR_SETTINGS, MonitorExperiment
from edp.config.twin import TWIN_SETTINGS, TwinExperiment
from edp.data.screening import ScreeningSpec
from edp.export.base import TARGETS
from edp.ir.rls import AdaptationSpec
from edp.registry import Registry
from edp.sim.scenario_file import ScenarioFile
from edp.workflows.auto.settings import Portfolio
from edp.workflows.compression import CompressionSearchSpec, DistilSpec
from edp.workflows.feature_selection.trials import TrialSpec
from edp.workflows.pretraining import MetaSpec
from edp.workflows.search.settings import SearchSpec
from edp.workflows.transfer import FinetuneSpec

TABLES: Mapping[str, type] = {
    "auto": Portfolio,
    "adapt": AdaptationSpec,
    "compress": CompressionSearchSpec,
    "distil": DistilSpec,
    "finetune": FinetuneSpec,
    "pretrain": MetaSpec,
    "screen": ScreeningSpec,
    "search": SearchSpec,
    "trials": TrialSpec,
}
"""Tables of commands by name."""
_ROOTS: Mapping[str, tuple[type, ...]] = {
    "simulate": (ScenarioFile,),
    "twin": (TwinExperiment,),
    "calibrate": (TwinExperiment,),
    "loop": (ControlExperiment,),
    "monitor": (MonitorExperiment,),
}
"""What keys begin in, by the first word of a command; an experiment and the tables of commands for all others."""
TREES = (SETTINGS, TWIN_SETTINGS, CONTROL_SETTINGS, MONITOR_SETTINGS)
_CONTROLLER_OPTIONS = frozenset(("iterations", "newton"))
"""Of `edp export --format controller`, whose options are no dataclass."""


def unknown_keys(words: tuple[str, ...], changes: list[str]) -> list[str]:
    """Keys of ``--set`` changes that do not exist for a command.

    Args:
        words: of the command line, the first is the command; empty: whichever command.
        changes: ``key.path=value`` each; placeholders without ``=`` are passed over.
    """
    command = words[0] if words else ""
    if command == "train" and (FOCUS, SIMULATION) in pairwise(words):
        command = "twin"
    keys = [change.partition("=")[0].strip() for change in changes if "=" in change]
    return [key for key in keys if key not in ("key", "key.path") and not _exists(command, key)]


def _exists(command: str, key: str) -> bool:
    path = [part for part in re.split(r"\.", key) if part]
    if (
        command in ("export", "")
        and len(path) == 1
        and (path[0] in _CONTROLLER_OPTIONS or path[0] in _export_options())
    ):
        return True
    if command in _ROOTS:
        return any(_follow(root, path) for root in _ROOTS[command])
    if path[0] in TABLES:
        return _follow(TABLES[path[0]], path[1:])
    roots = {Experiment} | ({root for found in _ROOTS.values() for root in found} if not command else set())
    return any(_follow(root, path) for root in roots)


def _export_options() -> set[str]:
    targets: list[Any] = [target for target in TARGETS.values() if is_dataclass(target)]
    return {entry.name for target in targets for entry in fields(target)}


def _follow(cls: type, path: list[str]) -> bool:
    """Whether a path of keys leads from a spec to a field."""
    if not path:
        return True
    if path[0] == "kind":
        return len(path) == 1
    hints = typing.get_type_hints(cls) if is_dataclass(cls) else {}
    names = {entry.name for entry in fields(cls)} if is_dataclass(cls) else set()
    if path[0] not in names:
        return False
    inner = list(_specs(path[0], hints[path[0]]))
    return len(path) == 1 or any(_follow(spec, path[1:]) for spec in inner) or _free(hints[path[0]])


def _specs(name: str, hint: Any) -> Iterator[type]:
    """Return the specs that a field may contain: specs of its type and of the registry with its name."""
    for tree in TREES:
        registry: Registry[type] | None = tree.parts.get(name)
        if registry is not None:
            yield from registry.values()
    if is_dataclass(hint) and isinstance(hint, type):
        yield hint
    for inner in typing.get_args(hint):
        yield from _specs("", inner)


def _free(hint: Any) -> bool:
    """Whether a field is a table of names that the user chooses."""
    return typing.get_origin(hint) is Mapping or any(map(_free, typing.get_args(hint)))
