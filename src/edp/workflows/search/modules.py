"""The modules that a search may add to a network: the fourteen of the thesis's Table 4.5, and every other block."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, TypeAlias, cast

from edp.config.experiment import plain_tree
from edp.errors import ConfigError, closest
from edp.networks.blocks import BLOCKS, BlockSpec
from edp.networks.heads import GluHead
from edp.networks.losses import Correlation
from edp.networks.predictor import check_combination
from edp.registry import Registry
from edp.settings.tree import value_at, with_value
from edp.workflows.search.arms import Arm
from edp.workflows.search.space import Choice, Value


@dataclass(frozen=True)
class Module:
    """One optional part of a network.

    Attributes:
        title: name in the thesis; a block beyond the thesis has its own name.
        change: settings laid over those of the baseline.
        block: a block that is appended to the baseline's; None for none.
        options: values to search where the module is on, by the place of the setting: keys joined by points, or
            the name of an option of the block.
        alter: returns the changed arm, where what changes depends on its settings; None for nothing.
    """

    title: str
    change: Mapping[str, object] = field(default_factory=dict)
    block: Mapping[str, object] | None = None
    options: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    alter: Callable[[Arm], Arm] | None = None


class _Modules(Mapping[str, Module]):
    """Modules of the thesis in its order, followed by all other searchable blocks.

    Blocks are looked up when asked for, so that a block that is registered later is searched, too.
    """

    def __getitem__(self, name: str) -> Module:
        if name in THESIS_MODULES:
            return THESIS_MODULES[name]
        if name in self._further():
            return Module(name.replace("_", " ").title(), block={"kind": name}, options=_space(name))
        raise ConfigError(f"unknown module '{name}'{closest(name, list(self))}")

    def __contains__(self, name: object) -> bool:
        return name in THESIS_MODULES or name in self._further()

    def __iter__(self) -> Iterator[str]:
        yield from THESIS_MODULES
        yield from self._further()

    def __len__(self) -> int:
        return len(THESIS_MODULES) + len(self._further())

    @staticmethod
    def _further() -> list[str]:
        return [name for name in BLOCKS if name not in THESIS_MODULES and cast(type[BlockSpec], BLOCKS[name]).space]


THESIS_MODULES: Registry[Module] = Registry("module")
"""Thesis Table 4.5."""
MODULES = _Modules()
"""All modules by name: what a search takes unless ``search.modules`` names some."""
TOGGLES: Registry[Module] = Registry("toggle")
"""Parts of the training that thesis Table 4.6 lists among what phases 4 and 5 may switch on; no module of Table 4.5."""

Shape: TypeAlias = Callable[[Arm], Arm]
"""Gives an arm the widths that follow from others (`edp.workflows.search.space.WIDTHS`)."""


def _space(name: str) -> Mapping[str, Sequence[Any]]:
    """Return the values worth searching of a block's options."""
    return cast(type[BlockSpec], BLOCKS[name]).space


def _block(name: str, title: str, **fixed: Any) -> None:
    # Options that the thesis fixes are not searched.
    free = {key: values for key, values in _space(name).items() if key not in fixed}
    THESIS_MODULES.register(name)(Module(title, block={"kind": name, **fixed}, options=free))


def _change(
    name: str, title: str, part: str, change: Mapping[str, object], options: Mapping[str, Sequence[Any]] | None = None
) -> None:
    placed = {f"model.{part}.{key}": values for key, values in (options or {}).items()}
    THESIS_MODULES.register(name)(Module(title, {"model": {part: change}}, options=placed))


_block("cylinder_gate", "Cyl Gate Diagonal", form="diagonal")
_block("temporal_difference", "Temporal Diff")
_block("cross_cylinder_attention", "Cross Cyl Attn")
_change("gru", "GRU Backbone", "backbone", {"cell": {"kind": "gru"}})
_change("layer_norm_lstm", "LayerNorm LSTM", "backbone", {"cell": {"kind": "layer_norm_lstm"}})
_block("multi_scale_tcn", "Multiscale TCN")
_change("zoneout", "Zoneout", "backbone", {"zoneout": 0.1}, {"zoneout": (0.05, 0.1, 0.2)})
_block("attention_bridge", "Attention Bridge")
_block("global_average_pooling", "Global Avg Pool")
_block("squeeze_excitation", "Squeeze-Excitation")
_change("physics_residual", "Physics Residual", "physics", {"kind": "force"})
_change("deeper_head", "Deeper Head", "head", {"layers": 2}, {"layers": (2, 3)})
_change("glu_head", "GLU Head", "head", {"kind": "glu"}, {"hidden": GluHead.space["hidden"]})
_change("stanh", "STanh Activation", "activation", {"kind": "stanh"})


def _correlation(arm: Arm) -> Arm:
    """Add the correlation term with its weight, unless the training has one."""
    terms = arm.get("training.terms", [])
    if any(term["kind"] == "correlation" for term in terms):
        return arm
    return arm.with_value("training.terms", [*terms, *plain_tree((Correlation(),), "terms")])


def _focal(arm: Arm) -> Arm:
    """Use the focal loss, which weights large errors more; for a squared loss, set its threshold above every error."""
    if arm["training.loss.kind"] == "focal":
        return arm
    delta = arm.get("training.loss.delta", NO_THRESHOLD)
    return arm.with_value("training.loss", {"kind": "focal", "gamma": 2.0, "delta": delta})


NO_THRESHOLD = 1e6
"""Standard deviations of the target: errors that do not occur, so that the focal form of the squared error results."""

TOGGLES.register("swa")(Module("SWA", {"training": {"average": {"kind": "swa"}}}))
TOGGLES.register("correlation_loss")(Module("Correlation Loss", alter=_correlation))
TOGGLES.register("focal_loss")(Module("Focal Loss", alter=_focal))


def part_of(name: str) -> Module:
    """Return a module or a toggle.

    Raises:
        ConfigError: there is none of this name.
    """
    return TOGGLES[name] if name in TOGGLES else MODULES[name]


def title_of(name: str) -> str:
    """Return the thesis's name of a module or a toggle."""
    return part_of(name).title


def add_modules(
    arm: Arm,
    names: Iterable[str],
    channels: Sequence[str] = (),
    options: Mapping[str, Value] | None = None,
    shape: Shape | None = None,
) -> Arm:
    """Return an arm with these modules added in the order of the registry, so that equal sets give equal arms.

    Args:
        arm: arm with all settings of an experiment.
        names: registered modules and toggles.
        channels: channels of the recordings, for the feature set ``all``.
        options: values of `options_of` for some of the modules; those that a module has anyway change nothing.
        shape: gives the result its widths, before the options.

    Raises:
        ConfigError: an unknown module or option, or modules that contradict one another or the network; every reason.
    """
    # Sets, so that the order of names cannot make two keys of one network.
    module_names = set(names)
    reasons = conflicts(arm, module_names, channels)
    if reasons:
        raise ConfigError("modules: " + "; ".join(reasons))
    changed = _add_modules(arm, module_names)
    if shape is not None:
        changed = shape(changed)
    for name in (name for name in MODULES if name in module_names):
        for key, option in _options(arm, name, shape).items():
            # What is not chosen keeps its present value, which is always among the options.
            label = (options or {}).get(key, option.present)
            if label not in option.values:
                raise ConfigError(f"modules: {key} = {label!r}; one of {list(option.values)} must hold")
            if label != option.present:
                changed = option.put(changed, option.values[label])
    return changed


def options_of(arm: Arm, name: str, shape: Shape | None = None) -> dict[str, Choice]:
    """Return the options of an active module that may vary, as dimensions ``module.option``.

    Args:
        arm: arm to which the module would be added; its present value is among the options.
        name: name of the module, or of a toggle, which has no options.
        shape: see `add_modules`.
    """
    options = {key: tuple(option.values) for key, option in _options(arm, name, shape).items()}
    return {key: Choice(values) for key, values in options.items() if len(values) > 1}


def present_options(arm: Arm, names: Iterable[str], shape: Shape | None = None) -> dict[str, Value]:
    """Return the present options of these modules, before any choice."""
    return {key: option.present for name in names for key, option in _options(arm, name, shape).items()}


@dataclass(frozen=True)
class _Option:
    """A setting of a module: its values by the label that a sampler sees, the label of the present one, where it is.

    Without a `kind` of block the path begins at the whole experiment.
    """

    values: Mapping[Value, Any]
    present: Value
    path: str
    kind: object

    def put(self, arm: Arm, value: Any) -> Arm:
        """Return an arm with another value of the setting."""
        plain = list(value) if isinstance(value, tuple) else value
        if self.kind is None:
            return arm.with_value(self.path, plain)
        blocks = list(arm["model.blocks"])
        index = next(i for i, block in enumerate(blocks) if block["kind"] == self.kind)
        blocks[index] = with_value(blocks[index], self.path, plain)
        return arm.with_value("model.blocks", blocks)


def _options(arm: Arm, name: str, shape: Shape | None = None) -> dict[str, _Option]:
    module, options = part_of(name), {}
    if not module.options:
        return {}  # a search asks for those of every module thousands of times
    whole = Arm(plain_tree(_add_modules(arm, {name}).experiment(f"with {name}")))
    if shape is not None:
        whole = shape(whole)
    part, kind = whole.tables, None if module.block is None else module.block["kind"]
    if kind is not None:
        part = next(block for block in whole["model.blocks"] if block["kind"] == kind)
    for path, values in module.options.items():
        present = _label(value_at(part, path))
        # A value of the settings outside of the searched ones stays possible.
        labelled = {_label(value): value for value in values}
        if present not in labelled:
            labelled = {present: value_at(part, path), **labelled}
        options[f"{name}.{path.rpartition('.')[2]}"] = _Option(labelled, present, path, kind)
    return options


def _label(value: Any) -> Value:
    """Return a value that a sampler can hold: a list as text."""
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value))
    scalar: Value = value
    return scalar


def conflicts(arm: Arm, names: Iterable[str], channels: Sequence[str] = ()) -> list[str]:
    """Return why these modules cannot be used together on this network; empty where they can.

    Two modules contradict one another where they set the same value differently, and all of them where the parts of
    the network say so.

    Raises:
        ConfigError: an unknown module.
    """
    module_names = set(names)
    chosen = [(name, part_of(name)) for name in sorted(module_names)]
    reasons = []
    for (one, first), (other, second) in combinations(chosen, 2):
        mine, theirs = dict(_leaves(first.change)), dict(_leaves(second.change))
        both = sorted(path for path in mine.keys() & theirs.keys() if mine[path] != theirs[path])
        if both:
            reasons.append(f"'{one}' and '{other}' both set {', '.join(both)}; keep one of them")
    if reasons:
        return reasons
    try:
        # Building the experiment is the rule: every part knows its own conflicts.
        experiment = _add_modules(arm, module_names).experiment(
            "with " + (", ".join(sorted(module_names)) or "no modules")
        )
        # Conflicts do not depend on the rate; 100 Hz is the thesis's.
        task = experiment.task.resolve(100.0, channels, physics=experiment.model.physics)
        check_combination(task, experiment.model)
    except ConfigError as error:
        return [str(error)]
    return []


def fitting(arm: Arm, channels: Sequence[str] = (), among: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the modules that this network can have, in the order of the registry, and does not have already.

    Args:
        arm: arm with the network.
        channels: channels of the recordings, for the feature set ``all``.
        among: names of those that are asked about; empty for all.
    """
    free = (name for name in MODULES if (not among or name in among) and _add_modules(arm, {name}) != arm)
    return tuple(name for name in free if not conflicts(arm, (name,), channels))


def contradicting(arm: Arm, names: Iterable[str], channels: Sequence[str] = ()) -> frozenset[frozenset[str]]:
    """Return the pairs of modules that fit alone, but not together."""
    pairs = combinations(sorted(set(names)), 2)
    return frozenset(frozenset(pair) for pair in pairs if conflicts(arm, pair, channels))


def _add_modules(arm: Arm, names: set[str]) -> Arm:
    for name, module in (*MODULES.items(), *TOGGLES.items()):
        if name not in names:
            continue
        arm = arm.merged(module.change)
        # A block of the same kind with other options is replaced, not doubled.
        if module.block is not None and module.block not in arm["model.blocks"]:
            others = [block for block in arm["model.blocks"] if block["kind"] != module.block["kind"]]
            arm = arm.with_value("model.blocks", [*others, module.block])
        if module.alter is not None:
            arm = module.alter(arm)
    return arm


def _leaves(table: Mapping[str, object], before: str = "") -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value
