"""The typed tree of settings: TOML in, validated specs out, every problem reported at once with the closest key."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path

import tomli_w

from edp.data.augment import AUGMENTATIONS
from edp.data.feature_files import is_set_file, read_set_table
from edp.data.features import FEATURE_SETS, Derived, FeatureSet
from edp.data.frozen import SPLITS
from edp.data.splits import ByRecording, SplitSpec
from edp.data.task import TargetMode, Task, check_ends
from edp.errors import ConfigError, closest
from edp.evaluation.judge import JudgeSpec
from edp.networks.losses import LOSSES, TERMS
from edp.networks.physics import PhysicsSpec
from edp.networks.plain import NETWORK_PARTS, USUAL_KINDS
from edp.networks.predictor import ModelSpec
from edp.settings.tree import (
    Change,
    SettingsTree,
    combined,
    merged,
    override,
    parse_toml,
    read_toml,
    value_at,
    with_value,
)
from edp.training.averages import AVERAGES
from edp.training.fit import TrainingSpec
from edp.training.optimizers import OPTIMIZERS
from edp.training.schedules import SCHEDULES

__all__ = [
    "PRESETS",
    "SETTINGS",
    "Change",
    "Experiment",
    "FeatureSettings",
    "TaskSettings",
    "build",
    "embed_feature_set",
    "experiment_toml",
    "load_experiment",
    "merged",
    "override",
    "plain_tree",
    "preset_table",
    "read_layers",
    "read_toml",
]

SETTINGS = SettingsTree(
    {
        **NETWORK_PARTS,
        "augmentations": AUGMENTATIONS,
        "loss": LOSSES,
        "terms": TERMS,
        "optimizer": OPTIMIZERS,
        "schedule": SCHEDULES,
        "average": AVERAGES,
        "split": SPLITS,
    },
    USUAL_KINDS,
)
"""Reads and writes the tables of an experiment and of its parts."""
build = SETTINGS.build
plain_tree = SETTINGS.to_dict
PRESETS = ("quick", "small", "ensemble", "standard", "thesis", "pressures", "positions")
EARLIER_PRESETS = {"committee": "ensemble"}
"""Presets of earlier versions, and the presets that replace them."""
AUTO = "auto"
"""The preset that leaves network and training to `edp.workflows.auto`; it is no experiment by itself."""
PRESET_NAMES = (AUTO, *PRESETS)


@dataclass(frozen=True, kw_only=True)
class FeatureSettings:
    """A user's own feature set; see `edp.data.features.FeatureSet`.

    Attributes:
        name: name of the set in reports.
        channels: logged channels that the network reads, in order.
        derived: channels that are computed sample by sample inside the model, appended in order.
        hidden: logged channels that serve as sources of derived channels only.
        init_channels: logged channels that are read in the first samples after a reset only, as initial state.
        init_samples: number of samples after a reset in which `init_channels` are read.
    """

    name: str = "own"
    channels: tuple[str, ...] = ()
    derived: tuple[Derived, ...] = ()
    hidden: tuple[str, ...] = ()
    init_channels: tuple[str, ...] = ()
    init_samples: int = 5

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
        """Return the task for recordings of `rate_hz` with these channels, including the inputs of a physics base."""
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
    """All settings of a training and its evaluation.

    Attributes:
        task: channels to read and to predict.
        split: division of the recordings.
        model: the network.
        training: settings of the training.
        evaluation: settings of the evaluation.
    """

    task: TaskSettings = field(default_factory=TaskSettings)
    split: SplitSpec = field(default_factory=ByRecording)
    model: ModelSpec = field(default_factory=ModelSpec)
    training: TrainingSpec = field(default_factory=TrainingSpec)
    evaluation: JudgeSpec = field(default_factory=JudgeSpec)


def load_experiment(
    path: str | Path | None = None,
    preset: str | None = "standard",
    overrides: Sequence[Change] = (),
    aside: Collection[str] = (),
) -> Experiment:
    """Load settings from a preset, changed by a TOML file, changed by overrides.

    Without a preset the file is taken as it stands, over the defaults of the specs: what a run folder keeps is whole.

    Args:
        path: settings file.
        preset: name of a preset; None for none.
        overrides: each ``key.path=value``, or a table.
        aside: tables of the file and the overrides that are a command's own (`edp.config.commands`).

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    where = f"preset '{preset}'"
    if preset == AUTO:
        raise ConfigError(
            f"the preset '{AUTO}' chooses a network by the recordings; only edp train does so. Here name one of "
            f"{', '.join(PRESETS)}"
        )
    table = {} if preset is None else preset_table(preset)
    if path is not None:
        where = f"'{path}'"
    for layer in read_layers(path, overrides):
        table = merged(table, {key: value for key, value in layer.items() if key not in aside})
    where += " with --set" if overrides else ""
    return build(Experiment, table, where)


def read_layers(path: str | Path | None = None, overrides: Sequence[Change] = ()) -> list[dict[str, object]]:
    """Return the table of a settings file and of all overrides, in the order of application.

    Raises:
        ConfigError: a file or an override that cannot be read.
    """
    # Files named in settings lie beside the settings file, files named on the command line in the working directory.
    first = [] if path is None else [embed_feature_set(read_toml(path), Path(path).parent)]
    every = combined([embed_feature_set(override(change), Path()) for change in overrides])
    # All overrides are renamed together: an earlier and a present name of one key are an error also in two overrides.
    return [SETTINGS.renamed(Experiment, table) for table in first + ([every] if every else [])]


def preset_table(name: str) -> dict[str, object]:
    """Return the table of a preset, merged with its `base` if it names one.

    Raises:
        ConfigError: there is none of this name.
    """
    name = EARLIER_PRESETS.get(name, name)
    if name not in (*PRESETS, AUTO):
        raise ConfigError(f"there is no preset '{name}'{closest(name, (*PRESETS, AUTO))}")
    text = resources.files("edp.config").joinpath(f"presets/{name}.toml").read_text(encoding="utf-8")
    table = parse_toml(text, f"preset '{name}'")
    base = table.pop("base", None)
    return table if base is None else merged(preset_table(str(base)), table)


def experiment_toml(experiment: Experiment) -> str:
    """Return the complete settings as TOML, including defaults, for the run folder."""
    # Defaults included: a run must not change with the defaults of a later version.
    return tomli_w.dumps(plain_tree(experiment))


def embed_feature_set(table: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return `table` with the feature set in place of its file name, so that a run folder is self-contained."""
    name = value_at(table, "task.features")
    if not is_set_file(name):
        return dict(table)
    features = read_set_table(folder / name)
    # Checked here, where the file can still be named.
    build(FeatureSettings, features, f"'{folder / name}'")
    return with_value(table, "task.features", features)
