"""Networks and tasks as plain values: what bundles and settings keep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edp.data.task import Task
from edp.errors import BundleError, ConfigError
from edp.networks.activations import ACTIVATIONS
from edp.networks.backbones import BACKBONES
from edp.networks.blocks import BLOCKS
from edp.networks.cells import CELLS
from edp.networks.heads import HEADS
from edp.networks.initial import INITIAL_STATES
from edp.networks.outputs import OUTPUTS
from edp.networks.physics import PHYSICS
from edp.networks.predictor import ModelSpec
from edp.registry import Registry
from edp.settings.tree import SettingsTree, Table, plain_tree
from edp.settings.tree import build as build_plain

NETWORK_PARTS: Mapping[str, Registry[type]] = {
    "backbone": BACKBONES,
    "cell": CELLS,
    "initial": INITIAL_STATES,
    "head": HEADS,
    "activation": ACTIVATIONS,
    "output": OUTPUTS,
    "blocks": BLOCKS,
    "physics": PHYSICS,
}
"""Registries of the network parts, by the field of the specification that contains the part."""
USUAL_KINDS = {"head": "mlp"}
"""Default kind of the heads. Files omit the kind of heads of this kind."""
NETWORK = SettingsTree(NETWORK_PARTS, USUAL_KINDS)


def unknown_parts(plain: Any) -> list[str]:
    """Return a sentence for each kind of a plain network spec that its registry does not have."""
    sentences: list[str] = []
    if not isinstance(plain, Mapping):
        return sentences
    for name, value in plain.items():
        for table in value if isinstance(value, list) else [value]:
            kind = table.get("kind") if isinstance(table, Mapping) else None
            if name in NETWORK_PARTS and isinstance(kind, str):
                try:
                    _ = NETWORK_PARTS[name][kind]
                except ConfigError as error:
                    sentences.append(str(error))
            sentences += unknown_parts(table)
    return sentences


def model_to_dict(spec: ModelSpec) -> Table:
    """Convert a network spec to JSON types; options that are None are omitted."""
    plain: Table = NETWORK.to_dict(spec)
    return plain


def model_from_dict(plain: Mapping[str, object]) -> ModelSpec:
    """Create a network spec from JSON types; without ``physics`` it has no physics base.

    Raises:
        BundleError: a value that this version does not understand.
    """
    try:
        return NETWORK.build(ModelSpec, plain, "of the bundle's network")
    # A bundle is data from outside: its faults are faults of the bundle, not of the user's settings.
    except ConfigError as error:
        raise BundleError(f"the bundle's network is not understood by this version: {error}") from error


def task_to_dict(task: Task) -> Table:
    """Convert a task to JSON types."""
    plain: Table = plain_tree(task)
    return plain


def task_from_dict(plain: Mapping[str, object]) -> Task:
    """Create a task from JSON types.

    Raises:
        BundleError: a value that this version does not understand.
    """
    try:
        return build_plain(Task, plain, "of the bundle's task")
    except ConfigError as error:
        raise BundleError(f"the bundle's task is not understood by this version: {error}") from error
