"""Tasks and network specs as plain JSON values and back: what bundles store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from enum import StrEnum
from typing import Any

from edp.blocks import BLOCKS
from edp.data.features import Derived, FeatureSet
from edp.data.task import TargetMode, Task
from edp.errors import BundleError, ConfigError
from edp.models.activations import ACTIVATIONS
from edp.models.backbones import BACKBONES
from edp.models.cells import CELLS
from edp.models.heads import HEADS
from edp.models.initial import INITIAL_STATES
from edp.models.outputs import OUTPUTS
from edp.models.physics import PHYSICS
from edp.models.predictor import ModelSpec
from edp.registry import Registry
from edp.signals import Kind

Plain = dict[str, Any]

NESTED: Mapping[str, Registry[type]] = {"cell": CELLS, "initial": INITIAL_STATES}
"""Options that are registered parts themselves."""


def listed(value: Any) -> Any:
    """Tuples as lists and enums as strings, recursively."""
    if isinstance(value, StrEnum):
        return str(value)
    if isinstance(value, tuple | list):
        return [listed(item) for item in value]
    return value


def options(spec: Any) -> Plain:
    """The options of a spec, plain."""
    held = {field.name: getattr(spec, field.name) for field in fields(spec)}
    return {name: tagged(value, NESTED[name]) if name in NESTED else listed(value) for name, value in held.items()}


def tagged(spec: Any, registry: Registry[type]) -> Plain:
    """The options of a registered spec with its name under ``kind``."""
    return {"kind": registry.name_of(spec), **options(spec)}


def untagged(plain: Mapping[str, Any], registry: Registry[type]) -> Any:
    """A registered spec from its plain form.

    Raises:
        BundleError: an option that this version does not know.
    """
    try:
        rest = {
            key: untagged(value, NESTED[key]) if key in NESTED else _tupled(value)
            for key, value in plain.items()
            if key != "kind"
        }
        return registry[plain["kind"]](**rest)
    except (TypeError, KeyError) as error:
        raise BundleError(f"{registry.what} {dict(plain)} is not understood by this version: {error}") from error


def _tupled(value: Any) -> Any:
    return tuple(_tupled(item) for item in value) if isinstance(value, list) else value


def model_to_plain(spec: ModelSpec) -> Plain:
    """A network spec as JSON values."""
    return {
        "backbone": tagged(spec.backbone, BACKBONES),
        "head": tagged(spec.head, HEADS),
        "activation": tagged(spec.activation, ACTIVATIONS),
        "output": tagged(spec.output, OUTPUTS),
        "blocks": [tagged(block, BLOCKS) for block in spec.blocks],
        "window": spec.window,
        "physics": None if spec.physics is None else tagged(spec.physics, PHYSICS),
    }


def model_from_plain(plain: Mapping[str, Any]) -> ModelSpec:
    """A network spec from JSON values; one without ``physics`` has no physics base."""
    physics = plain.get("physics")
    return ModelSpec(
        backbone=untagged(plain["backbone"], BACKBONES),
        head=untagged({"kind": "mlp", **plain["head"]}, HEADS),
        activation=untagged(plain["activation"], ACTIVATIONS),
        output=untagged(plain.get("output", {"kind": "point"}), OUTPUTS),
        blocks=tuple(untagged(block, BLOCKS) for block in plain["blocks"]),
        window=plain["window"],
        physics=None if physics is None else untagged(physics, PHYSICS),
    )


def task_to_plain(task: Task) -> Plain:
    """A task as JSON values."""
    features = task.features
    return {
        "features": {
            "name": features.name,
            "channels": list(features.channels),
            "hidden": list(features.hidden),
            "derived": [options(entry) for entry in features.derived],
            "starting": list(features.starting),
            "starting_ticks": features.starting_ticks,
        },
        "targets": list(task.targets),
        "horizons": list(task.horizons),
        "mode": str(task.mode),
        "rate_hz": task.rate_hz,
        "derived_targets": [options(entry) for entry in task.derived_targets],
        "integrate": listed(task.integrate),
        "physics": listed(task.physics),
    }


def task_from_plain(plain: Mapping[str, Any]) -> Task:
    """A task from JSON values.

    Raises:
        BundleError: a value that this version does not understand.
    """
    try:
        held = plain["features"]
        features = FeatureSet(
            name=held["name"],
            channels=tuple(held["channels"]),
            derived=tuple(map(_derived, held["derived"])),
            hidden=tuple(held["hidden"]),
            starting=tuple(held.get("starting", ())),
            starting_ticks=held.get("starting_ticks", 5),
        )
        return Task(
            features=features,
            targets=tuple(plain["targets"]),
            horizons=tuple(plain["horizons"]),
            mode=TargetMode(plain["mode"]),
            rate_hz=float(plain["rate_hz"]),
            derived_targets=tuple(map(_derived, plain["derived_targets"])),
            integrate=tuple(plain["integrate"]),
            physics=tuple(plain.get("physics", ())),
        )
    except (KeyError, TypeError, ValueError, ConfigError) as error:
        raise BundleError(f"the bundle's task is not understood by this version: {error}") from error


def _derived(plain: Mapping[str, Any]) -> Derived:
    return Derived(plain["name"], plain["source"], plain["how"], Kind(plain["kind"]))
