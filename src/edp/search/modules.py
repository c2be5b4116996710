"""The modules that a search may add to a network: the fourteen of the thesis's Table 4.5, each a change of settings."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from edp.config import Experiment, Table, build, merged
from edp.errors import ConfigError
from edp.models.predictor import check_combination
from edp.registry import Registry


@dataclass(frozen=True)
class Module:
    """One optional part of a network.

    Attributes:
        title: what the thesis calls it.
        change: settings laid over the baseline's.
        block: a block that is appended to the baseline's; None for none.
    """

    title: str
    change: Mapping[str, Any] = field(default_factory=dict)
    block: Mapping[str, Any] | None = None


MODULES: Registry[Module] = Registry("module")


def _block(name: str, title: str, **options: Any) -> None:
    MODULES.register(name)(Module(title, block={"kind": name, **options}))


def _change(name: str, title: str, part: str, options: Mapping[str, Any]) -> None:
    MODULES.register(name)(Module(title, {"model": {part: options}}))


_block("cylinder_gate", "Cyl Gate Diagonal", form="diagonal")
_block("temporal_difference", "Temporal Diff")
_block("cross_cylinder_attention", "Cross Cyl Attn")
_change("gru", "GRU Backbone", "backbone", {"cell": {"kind": "gru"}})
_change("layer_norm_lstm", "LayerNorm LSTM", "backbone", {"cell": {"kind": "layer_norm_lstm"}})
_block("multi_scale_tcn", "Multiscale TCN")
_change("zoneout", "Zoneout", "backbone", {"zoneout": 0.1})
_block("attention_bridge", "Attention Bridge")
_block("global_average_pooling", "Global Avg Pool")
_block("squeeze_excitation", "Squeeze-Excitation")
_change("physics_residual", "Physics Residual", "physics", {"kind": "force"})
_change("deeper_head", "Deeper Head", "head", {"layers": 2})
_change("glu_head", "GLU Head", "head", {"kind": "glu"})
_change("stanh", "STanh Activation", "activation", {"kind": "stanh"})


def with_modules(settings: Table, names: Iterable[str], channels: Sequence[str] = ()) -> Table:
    """Settings with these modules added, in the order of the registry, so that equal sets give equal settings.

    Args:
        settings: a whole experiment as plain tables (`edp.config.plain_tree`).
        names: registered modules.
        channels: of the recordings, for the feature set ``all``.

    Raises:
        ConfigError: an unknown module, or modules that contradict one another or the network; every reason.
    """
    wanted = set(names)
    reasons = conflicts(settings, wanted, channels)
    if reasons:
        raise ConfigError("modules: " + "; ".join(reasons))
    return _added(settings, wanted)


def conflicts(settings: Table, names: Iterable[str], channels: Sequence[str] = ()) -> list[str]:
    """Why these modules cannot be used together on this network; empty where they can.

    Two modules contradict one another where they set the same value differently, and all of them where the parts of
    the network say so.

    Raises:
        ConfigError: an unknown module.
    """
    wanted = set(names)
    chosen = [(name, MODULES[name]) for name in sorted(wanted)]
    reasons = []
    for (one, first), (other, second) in combinations(chosen, 2):
        mine, theirs = dict(_leaves(first.change)), dict(_leaves(second.change))
        both = sorted(".".join(path) for path in mine.keys() & theirs.keys() if mine[path] != theirs[path])
        if both:
            reasons.append(f"'{one}' and '{other}' both set {', '.join(both)}; keep one of them")
    if reasons:
        return reasons
    try:
        experiment = build(Experiment, _added(settings, wanted), "with " + (", ".join(sorted(wanted)) or "no modules"))
        task = experiment.task.resolve(100.0, channels, physics=experiment.model.physics)
        check_combination(task, experiment.model)
    except ConfigError as error:
        return [str(error)]
    return []


def fitting(settings: Table, channels: Sequence[str] = ()) -> tuple[str, ...]:
    """Modules that this network can have, in the order of the registry, and does not have already."""
    free = (name for name in MODULES if _added(settings, {name}) != settings)
    return tuple(name for name in free if not conflicts(settings, (name,), channels))


def contradicting(settings: Table, names: Iterable[str], channels: Sequence[str] = ()) -> frozenset[frozenset[str]]:
    """Pairs of modules that fit alone, but not together."""
    pairs = combinations(sorted(set(names)), 2)
    return frozenset(frozenset(pair) for pair in pairs if conflicts(settings, pair, channels))


def _added(settings: Table, names: set[str]) -> Table:
    made = copy.deepcopy(settings)
    for name, module in MODULES.items():
        if name not in names:
            continue
        made = merged(made, copy.deepcopy(dict(module.change)))
        if module.block is not None and dict(module.block) not in made["model"]["blocks"]:
            held = [block for block in made["model"]["blocks"] if block["kind"] != module.block["kind"]]
            made["model"]["blocks"] = [*held, dict(module.block)]
    return made


def _leaves(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*path, key))
        else:
            yield (*path, key), value
