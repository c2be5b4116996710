"""Small networks around a part, and the contracts of a registered spec and of a block."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from edp.config.experiment import SETTINGS
from edp.data.features import Derived, FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.backbones import BACKBONES, BackboneSpec, GruSpec, HybridSpec, LstmSpec, TcnSpec
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import OUTPUT_SLOTS, BlockSlot, BlockSpec
from edp.networks.heads import MlpHead, OutputBand
from edp.networks.predictor import ModelSpec, Predictor, build_model, check_combination
from edp.networks.trees import Trees
from edp.registry import Registry
from edp.testing.expectations import ContractError, expect
from edp.testing.streaming import check_network

# Nine ticks: odd, and no multiple of kernels or dilations.
WINDOW = 9
FEATURES = FeatureSet(
    "contract",
    ("CylVels_1", "CylVels_3", "pressure", "lever"),
    (Derived("dpressure", "pressure"), Derived("dload", "load", "derivative")),
    hidden=("load",),
)
TARGETS = ("CylVels_1", "CylVels_3")
# One horizon and two, changes and values: shapes that differ only there are told.
FORMS = tuple((horizons, mode) for horizons in ((3,), (1, 4)) for mode in (TargetMode.DELTA, TargetMode.ABSOLUTE))
"""Horizons and encodings in which networks are tried."""
SMALL_BACKBONES: Mapping[str, BackboneSpec] = {
    "lstm": LstmSpec(units=6),
    "gru": GruSpec(units=6),
    "tcn": TcnSpec(channels=(6, 4), kernel=3, dropout=0.2),
    "hybrid": HybridSpec(channels=(6,), kernel=3, units=5, dropout=0.2),
}
"""Options that make a backbone cheap; one that is not listed is tried with its defaults."""


def small_task(model: ModelSpec, horizons: tuple[int, ...] = (1, 4), mode: TargetMode = TargetMode.DELTA) -> Task:
    """Return a task with two targets and six features, one derived from a channel that is not a feature."""
    extra = () if model.physics is None else model.physics.channels()
    physics = tuple(name for name in extra if name not in FEATURES.inputs)
    return Task(FEATURES, TARGETS, horizons, mode, 100.0, physics=physics)


def small_network(model: ModelSpec, task: Task, shake: float = 0.2) -> Predictor:
    """Return a network with random scaling, in single precision and evaluation mode.

    Args:
        model: its structure.
        task: such as `small_task` gives.
        shake: standard deviation that is added to every weight: some parts start at zero or fully open, and every
            path is to take part.

    Raises:
        ConfigError: parts that contradict one another.
    """
    shape, features = (len(task.horizons), len(task.targets)), len(task.features.features)
    rng = np.random.default_rng(7)
    # Drawn scaling: an offset of zero or a width of one would hide a missing term.
    scaler = Scaler(
        rng.normal(size=features), rng.uniform(0.5, 2, features), rng.normal(size=shape), rng.uniform(0.5, 2, shape)
    )
    predictor = build_model(task, model, scaler, seed=3)
    draw = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for parameter in predictor.parameters():
            # Shaken weights: gates that start open and layers that start at zero would hide errors.
            parameter.add_(shake * torch.randn(parameter.shape, generator=draw))
        for part in predictor.modules():
            if isinstance(part, Trees):
                _draw_tables(part, rng)
            if isinstance(part, OutputBand):
                # From none to one that takes most of what a small network says.
                part.width.copy_(torch.linspace(0.0, 1.0, part.width.numel()).view_as(part.width))
    return predictor.eval()


def _draw_tables(trees: Trees, rng: np.random.Generator) -> None:
    """Set random tables whose nodes can go both ways, since the tables of a new network give zero."""
    feature = rng.integers(0, trees.width, trees.feature.shape)
    threshold, leaf = (rng.normal(size=table.shape).astype(np.float32) for table in (trees.threshold, trees.leaf))
    trees.set_tables(feature, threshold, 0.1 * leaf)


def check_spec(registry: Registry[Any], name: str) -> None:
    """Check that a registered part is a frozen dataclass with defaults for all options, and survives JSON.

    Raises:
        ContractError: one of them does not hold.
    """
    part = registry[name]
    expect(dataclasses.is_dataclass(part), f"{registry.what} '{name}' is no dataclass")
    try:
        spec = part()
    except TypeError as error:
        raise ContractError(f"{registry.what} '{name}' has an option without a default: {error}") from error
    # Settings files and bundles hold plain values: a part must survive the way there and back.
    plain = json.loads(json.dumps(SETTINGS.to_dict(spec)))
    expect(SETTINGS.build(part, plain, name) == spec, f"{registry.what} '{name}' is another one after JSON")
    expect(registry.name_of(spec) == name, f"{registry.what} '{name}' is registered under another name")
    for field in dataclasses.fields(spec):
        try:
            setattr(spec, field.name, None)
        except dataclasses.FrozenInstanceError:
            continue
        raise ContractError(f"{registry.what} '{name}' is not frozen: write @dataclass(frozen=True)")


def check_space(block: type[Any]) -> None:
    """Check that a block names its slot, and that its search space holds valid option values.

    Raises:
        ContractError: no slot, an option that it does not have, or a value that it refuses.
    """
    name = BLOCKS.name_of(block)
    expect(isinstance(block(), BlockSpec), f"block '{name}' lacks `slot` or `space`")
    expect(
        block.slot in BlockSlot, f"block '{name}' has the slot '{block.slot}'; one of {', '.join(BlockSlot)} must hold"
    )
    options = {field.name for field in dataclasses.fields(block)}
    for option, values in block.space.items():
        expect(option in options, f"block '{name}': its space names '{option}', which is no option of it")
        for value in values:
            try:
                block(**{option: value})
            except ConfigError as error:
                raise ContractError(f"block '{name}' refuses {option} = {value!r} of its own space: {error}") from error


def check_block(block: type[Any], **options: Any) -> None:
    """Check the contract of a structural module with every backbone that offers its slot.

    Args:
        block: a class entered with ``@BLOCKS.register("name")``.
        options: options of the block; choose a small block, because networks of five channels are built around it.

    Raises:
        ConfigError: it is not registered, refuses its options, or contradicts every network that is tried.
        ContractError: a contract is broken; the message says which and how.
    """
    name = BLOCKS.name_of(block)
    check_spec(BLOCKS, name)
    check_space(block)
    spec = block(**options)
    tried, reasons = 0, []
    for backbone_name in BACKBONES:
        backbone = SMALL_BACKBONES.get(backbone_name) or BACKBONES[backbone_name]()
        if spec.slot not in {*backbone.slots(), *OUTPUT_SLOTS}:
            continue
        for horizons, mode in FORMS:
            model = ModelSpec(backbone=backbone, head=MlpHead(hidden=6), blocks=(spec,), window=WINDOW)
            task = small_task(model, horizons, mode)
            try:
                check_combination(task, model)
            except ConfigError as error:
                reasons.append(str(error))
                continue
            try:
                check_network(small_network(model, task))
            except ContractError as error:
                where = f"backbone '{backbone_name}', horizons {list(horizons)}, {mode}"
                raise ContractError(f"block '{name}' ({where}): {error}") from error
            tried += 1
    expect(
        tried > 0, f"block '{name}' fits no network that was tried: {'; '.join(reasons) or 'no backbone has its slot'}"
    )
