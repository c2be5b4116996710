"""The typed tree of settings: TOML in, validated specs out, every problem reported at once with the closest key."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import pydantic
import tomli_w

from edp import storage
from edp.blocks import BLOCKS
from edp.bounds import shown
from edp.data.augment import AUGMENTATIONS
from edp.data.feature_files import is_set_file, read_set_table
from edp.data.features import FEATURE_SETS, Derived, FeatureSet
from edp.data.frozen import SPLITS
from edp.data.splits import ByRecording, SplitSpec
from edp.data.task import TargetMode, Task, check_ends
from edp.errors import ConfigError, closest
from edp.evaluation.judge import JudgeSpec
from edp.losses import LOSSES, TERMS
from edp.models.activations import ACTIVATIONS
from edp.models.backbones import BACKBONES
from edp.models.cells import CELLS
from edp.models.heads import HEADS
from edp.models.initial import INITIAL_STATES
from edp.models.outputs import OUTPUTS
from edp.models.physics import PHYSICS, PhysicsSpec
from edp.models.plain import options
from edp.models.predictor import ModelSpec
from edp.registry import Registry
from edp.training.averages import AVERAGES
from edp.training.fit import TrainingSpec
from edp.training.optimizers import OPTIMIZERS
from edp.training.schedules import SCHEDULES

TAGGED: Mapping[str, Registry[type]] = {
    "backbone": BACKBONES,
    "cell": CELLS,
    "initial": INITIAL_STATES,
    "head": HEADS,
    "activation": ACTIVATIONS,
    "output": OUTPUTS,
    "blocks": BLOCKS,
    "augmentations": AUGMENTATIONS,
    "physics": PHYSICS,
    "loss": LOSSES,
    "terms": TERMS,
    "optimizer": OPTIMIZERS,
    "schedule": SCHEDULES,
    "average": AVERAGES,
    "split": SPLITS,
}
"""Fields whose tables say with ``kind = "..."`` which registered part they set."""
USUAL_KIND = {"head": "mlp"}
"""What a table without ``kind`` means, where that is not an error."""

SHOWN_CHANGE = 200
"""Of a ``--set``, in messages."""
MOST_LISTED, MOST_KEY = 50, 100
"""Problems that a message lists, and characters of a key that it repeats."""
PRESETS = ("quick", "small", "standard", "thesis")
Table = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class FeatureSettings:
    """A user's own feature set; see `edp.data.features.FeatureSet`."""

    name: str = "own"
    channels: tuple[str, ...] = ()
    derived: tuple[Derived, ...] = ()
    hidden: tuple[str, ...] = ()
    starting: tuple[str, ...] = ()
    starting_ticks: int = 5

    def __post_init__(self) -> None:
        FeatureSet(**{entry.name: getattr(self, entry.name) for entry in fields(self)})


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """The task before the data's rate is known.

    Attributes:
        features: ``FG1``, ``FG2``, ``all`` (every channel of the recordings), or a table. The path of a feature-set
            file stands for its table; in a settings file it is relative to that file.
        targets: names of the predicted channels.
        horizons: look-ahead in samples.
        mode: ``delta`` or ``absolute``.
        derived_targets: derived channels that serve as targets only.
        integrate: targets whose running integral is judged too.
    """

    features: str | FeatureSettings = "FG2"
    targets: tuple[str, ...] = ("CylVels_1", "CylVels_2", "CylVels_3")
    horizons: tuple[int, ...] = (10,)
    mode: TargetMode = TargetMode.DELTA
    derived_targets: tuple[Derived, ...] = ()
    integrate: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ends(self)

    def resolve(self, rate_hz: float, channels: Sequence[str] = (), physics: PhysicsSpec | None = None) -> Task:
        """The task for recordings of `rate_hz` with these channels, with what a physics base reads beside them."""
        chosen = self.features
        if isinstance(chosen, FeatureSettings):
            features = FeatureSet(**{field.name: getattr(chosen, field.name) for field in fields(chosen)})
        elif chosen == "all":
            features = FeatureSet("all", tuple(channels))
        elif chosen in FEATURE_SETS:
            features = FEATURE_SETS[chosen]
        else:
            hint = closest(chosen, [*FEATURE_SETS, "all"])
            raise ConfigError(f"task.features: there is no feature set '{chosen}'{hint}")
        extra = () if physics is None else tuple(n for n in physics.channels() if n not in features.inputs)
        return Task(
            features, self.targets, self.horizons, self.mode, rate_hz, self.derived_targets, self.integrate, extra
        )


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Everything that settles a training and its judgement.

    Attributes:
        task: what is read and predicted.
        split: how recordings are divided.
        model: the network.
        training: how it is trained.
        judge: how it is judged.
    """

    task: TaskSettings = field(default_factory=TaskSettings)
    split: SplitSpec = field(default_factory=ByRecording)
    model: ModelSpec = field(default_factory=ModelSpec)
    training: TrainingSpec = field(default_factory=TrainingSpec)
    judge: JudgeSpec = field(default_factory=JudgeSpec)


def load_experiment(
    path: str | Path | None = None, preset: str | None = "standard", overrides: Sequence[str] = ()
) -> Experiment:
    """Settings from a preset, changed by a TOML file, changed by ``key.path=value`` overrides.

    Without a preset the file is taken as it stands, over the defaults of the specs: what a run folder keeps is whole.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    table: Table = {}
    where = f"preset '{preset}'"
    if preset is not None:
        table = preset_table(preset)
    if path is not None:
        table = merged(table, with_set_file(read_toml(path), Path(path).parent))
        where = f"'{path}'"
    for text in overrides:
        table = merged(table, with_set_file(override(text), Path()))
    where += " with --set" if overrides else ""
    return build(Experiment, table, where)


def preset_table(name: str) -> Table:
    """The table of a preset.

    Raises:
        ConfigError: there is none of this name.
    """
    if name not in PRESETS:
        raise ConfigError(f"there is no preset '{name}'{closest(name, PRESETS)}")
    text = resources.files("edp").joinpath(f"presets/{name}.toml").read_text(encoding="utf-8")
    return storage.parse_toml(text, f"preset '{name}'", ConfigError)


def experiment_toml(experiment: Experiment) -> str:
    """The whole settings as TOML, defaults included: what a run folder keeps."""
    return tomli_w.dumps(plain_tree(experiment))


def plain_tree(value: Any, name: str = "") -> Any:
    """Nested plain values of a spec tree; registered parts carry their ``kind``; None is left out."""
    if name in TAGGED and is_dataclass(value):
        return {"kind": TAGGED[name].name_of(value)} | _plain_fields(value)
    if name in TAGGED and isinstance(value, tuple):
        return [plain_tree(item, name) for item in value]
    if is_dataclass(value):
        return _plain_fields(value)
    if isinstance(value, tuple | list):
        return [plain_tree(item) for item in value]
    return str(value) if isinstance(value, TargetMode) or hasattr(value, "value") else value


def _plain_fields(value: Any) -> Table:
    held = {entry: getattr(value, entry) for entry in options(value)}
    return {key: plain_tree(item, key) for key, item in held.items() if item is not None}


def read_toml(path: str | Path) -> Table:
    """A settings file.

    Raises:
        ConfigError: it cannot be read, is beyond the bounds of `edp.storage.read_toml`, or is not TOML.
    """
    return storage.read_toml(path, error=ConfigError)


def merged(base: Table, change: Mapping[str, Any]) -> Table:
    """`base` with `change` laid over it; a table of another kind replaces the old one whole."""
    result = dict(base)
    for key, value in change.items():
        old = result.get(key)
        same = (
            isinstance(old, dict) and isinstance(value, dict) and value.get("kind", old.get("kind")) == old.get("kind")
        )
        result[key] = merged(old, value) if same and isinstance(old, dict) else value
    return result


def with_set_file(table: Table, folder: Path) -> Table:
    """`table` with the feature set that its ``task.features`` names by a file, so that a run folder keeps all of it."""
    task = table.get("task")
    if not isinstance(task, dict) or not is_set_file(task.get("features")):
        return table
    path = folder / task["features"]
    features = read_set_table(path)
    build(FeatureSettings, features, f"'{path}'")
    return {**table, "task": {**task, "features": features}}


def override(text: str) -> Table:
    """The table that one ``key.path=value`` stands for; a value that is no TOML is a string.

    Raises:
        ConfigError: not of this form.
    """
    key, sign, value = text.partition("=")
    if not sign or not key.strip():
        raise ConfigError(f"--set '{text}': write key.path=value, for example training.epochs=10")
    where = f"--set '{text[:SHOWN_CHANGE]}'"
    try:
        return storage.parse_toml(f"{key.strip()} = {value.strip()}", where, ConfigError)
    except ConfigError:
        return storage.parse_toml(f'{key.strip()} = "{value.strip()}"', where, ConfigError)


T = typing.TypeVar("T")


def build(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """A spec tree from a table.

    Raises:
        ConfigError: every problem found, with its key path and the closest known key.
    """
    problems: list[str] = []
    made = _build(cls, table, "", problems)
    if problems:
        more = [f"and {len(problems) - MOST_LISTED:,} more"] if len(problems) > MOST_LISTED else []
        listed = "\n  - ".join(problems[:MOST_LISTED] + more)
        count = f"{len(problems)} problem" + ("s" if len(problems) > 1 else "")
        raise ConfigError(f"settings {where}: {count}\n  - {listed}")
    return typing.cast(T, made)


def _build(cls: type, table: Any, path: str, problems: list[str]) -> Any:
    if not isinstance(table, Mapping):
        problems.append(f"{path}: expected a table, got {shown(table)}")
        return None
    hints = _hints(cls)
    known = [entry.name for entry in fields(cls)]
    before = len(problems)
    for key in table:
        if key not in known:
            problems.append(f"unknown key '{_join(path, _key(key))}'{closest(_key(key), known)}")
    for entry in fields(cls):
        required = entry.default is MISSING and entry.default_factory is MISSING
        if required and entry.name not in table:
            problems.append(f"'{_join(path, entry.name)}' is missing; it must be given")
    values = {
        name: _value(name, hints[name], table[name], _join(path, name), problems) for name in known if name in table
    }
    if len(problems) > before:
        return None
    try:
        return cls(**values)
    except ConfigError as error:
        problems.append(f"{path or 'top level'}: {error}")
        return None


def _value(name: str, hint: Any, value: Any, path: str, problems: list[str]) -> Any:
    if name in TAGGED:
        if typing.get_origin(hint) is tuple:
            items = value if isinstance(value, list) else [value]
            return tuple(_tagged(name, item, f"{path}[{i}]", problems) for i, item in enumerate(items))
        return _tagged(name, value, path, problems)
    choices = typing.get_args(hint) if typing.get_origin(hint) is not tuple else ()
    table_type = hint if is_dataclass(hint) else next((c for c in choices if is_dataclass(c)), None)
    if table_type is not None and (isinstance(value, Mapping) or table_type is hint):
        return _build(typing.cast(type, table_type), value, path, problems)
    item_type = next(iter(typing.get_args(hint)), None) if typing.get_origin(hint) is tuple else None
    if is_dataclass(item_type) and isinstance(value, list):
        made = [_build(typing.cast(type, item_type), v, f"{path}[{i}]", problems) for i, v in enumerate(value)]
        return tuple(made)
    if _truth_in(value) and bool not in _leaves(hint):
        problems.append(f"{path} = {shown(value)}: true and false are no numbers or names; write one")
        return None
    try:
        return _adapter(hint).validate_python(value)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        problems.append(f"{path} = {shown(value)}: {first['msg'][0].lower()}{first['msg'][1:]}")
        return None


# A search builds thousands of experiments, and making these took nine tenths of the time.
_hints = cache(typing.get_type_hints)


@cache
def _adapter(hint: Any) -> pydantic.TypeAdapter[Any]:
    return pydantic.TypeAdapter(hint, config=pydantic.ConfigDict(allow_inf_nan=False))


@cache
def _leaves(hint: Any) -> frozenset[Any]:
    """The types that a hint is made of."""
    inner = typing.get_args(hint)
    return frozenset().union(*map(_leaves, inner)) if inner else frozenset((hint,))


def _truth_in(value: Any) -> bool:
    """Whether a value is or holds true or false, which Python counts as numbers."""
    if isinstance(value, Mapping):
        return any(map(_truth_in, value.values()))
    return any(map(_truth_in, value)) if isinstance(value, list | tuple) else isinstance(value, bool)


def _tagged(name: str, table: Any, path: str, problems: list[str]) -> Any:
    registry = TAGGED[name]
    if isinstance(table, str):
        table = {"kind": table}
    if isinstance(table, Mapping) and name in USUAL_KIND:
        table = {"kind": USUAL_KIND[name], **table}
    if not isinstance(table, Mapping) or "kind" not in table:
        problems.append(f'{path}: say which {registry.what} with kind = "..."{closest("", registry)}')
        return None
    if not isinstance(table["kind"], str):
        problems.append(f"{path}.kind = {shown(table['kind'])}: the name of one must hold{closest('', registry)}")
        return None
    try:
        cls = registry[_key(table["kind"])]
    except ConfigError as error:
        problems.append(f"{path}.kind: {error}")
        return None
    return _build(cls, {key: value for key, value in table.items() if key != "kind"}, path, problems)


def _key(name: str) -> str:
    """A key or name as messages repeat it."""
    return name if len(name) <= MOST_KEY else f"{name[:MOST_KEY]}..."


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key
