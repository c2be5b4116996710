"""The settings of a search: a preset, a file, changes; and the experiment from which it starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from edp.config.experiment import (
    Experiment,
    FeatureSettings,
    build,
    embed_feature_set,
    merged,
    override,
    plain_tree,
    preset_table,
    read_toml,
)
from edp.data.feature_files import is_set_file, read_set_table
from edp.data.features import FEATURE_SETS
from edp.errors import ConfigError, closest
from edp.evaluation.controller import load_budget
from edp.settings.bounds import shown
from edp.settings.tree import combined, value_at, with_value
from edp.storage import parse_toml
from edp.workflows.search.arms import Arm
from edp.workflows.search.phases.isolation import DEFAULT_BACKBONE, arm_of
from edp.workflows.search.settings import MOVED, SearchSpec
from edp.workflows.search.space import DIMENSIONS, THESIS, WIDTHS, Choice, Range, Real, Space, applicable, apply

PRESETS = ("quick", "standard", "thesis")


@dataclass(frozen=True)
class SearchPlan:
    """Plan of a search: experiment, settings and space.

    Attributes:
        spec: the settings of the search.
        experiment: network, task and training from which it starts.
        preset: name of the preset that was taken, for the report.
    """

    spec: SearchSpec
    experiment: Experiment
    preset: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return the identity of a study, in parts that a message can name."""
        spec = plain_spec(self.spec)
        return {"space": spec.pop("space"), "search": spec, "network": Arm.from_experiment(self.experiment).tables}


def load_plan(path: str | Path | None = None, preset: str = "quick", overrides: Sequence[str] = ()) -> SearchPlan:
    """Load a plan from a preset, changed by a TOML file and by ``key.path=value`` overrides.

    The file is one of an experiment, with a table ``[search]`` beside the others, and may say with ``base`` from which
    preset of networks it starts. In ``[search.space]`` a dimension is ``{ low = .., high = .., log = true }`` or a list
    of values; ``false`` leaves it out.

    Raises:
        ConfigError: an unknown preset; names every unknown key, wrong type and impossible value.
    """
    if preset not in PRESETS:
        raise ConfigError(f"there is no preset '{preset}' of a search{closest(preset, PRESETS)}")
    text = resources.files("edp.workflows.search").joinpath(f"presets/{preset}.toml").read_text(encoding="utf-8")
    where = f"preset '{preset}' of the search"
    table = parse_toml(text, where, ConfigError)
    if path is not None:
        # Files named in settings are looked for beside the settings file, not in the working directory.
        table, where = merged(table, _read_named_files(read_toml(path), Path(path).parent)), f"'{path}'"
    table = merged(table, combined([_read_named_files(override(change), Path()) for change in overrides]))
    where += " with --set" if overrides else ""
    base, search = table.pop("base", "quick"), table.pop("search", {})
    if not isinstance(search, Mapping):
        raise ConfigError(f"settings {where}: search = {search!r}; expected a table")
    experiment = build(Experiment, merged(preset_table(str(base)), table), where)
    for key in search:
        if key in MOVED:
            raise ConfigError(f"settings {where}: 'search.{key}' is now called 'search.{MOVED[key]}'")
    spec = _spec(_use_task(dict(search), table, experiment), where)
    _check_parts(spec, Arm.from_experiment(experiment), f"settings {where}: search")
    # Scores exist for the horizons of the task only.
    if spec.horizon not in experiment.task.horizons:
        horizons = ", ".join(map(str, experiment.task.horizons))
        raise ConfigError(
            f"settings {where}: search.horizon = {spec.horizon}, and the task predicts {horizons} samples ahead; give "
            "one of these, or --set task.horizons=[...]"
        )
    return SearchPlan(spec, experiment, preset)


def _use_task(search: Mapping[str, object], table: Mapping[str, object], experiment: Experiment) -> dict[str, object]:
    """Use the feature set and the horizon of the task if ``[search]`` does not set them."""
    completed, features = dict(search), value_at(table, "task.features")
    if "features" not in search and features is not None:
        own = features if isinstance(features, str) else experiment.task.features
        completed["features"] = [own if isinstance(own, str) else plain_tree(own)]
    horizons = experiment.task.horizons
    if "horizon" not in search and SearchSpec.horizon not in horizons:
        completed["horizon"] = max(horizons)
    return completed


def _read_named_files(table: Mapping[str, object], folder: Path) -> dict[str, object]:
    """Return `table` with the feature sets and the budget that it names by files."""
    resolved = embed_feature_set(table, folder)
    budget, features = (value_at(table, f"search.{key}") for key in ("compression.budget", "features"))
    if isinstance(budget, str):
        resolved = with_value(resolved, "search.compression.budget", asdict(load_budget(folder / budget)))
    if isinstance(features, list):
        sets = [
            build(FeatureSettings, read_set_table(folder / one), f"'{folder / one}'") if is_set_file(one) else one
            for one in features
        ]
        resolved = with_value(resolved, "search.features", sets)
    return resolved


def _check_parts(spec: SearchSpec, base: Arm, where: str) -> None:
    """Check that every backbone, feature set and value of the space makes a valid experiment."""
    for name in spec.backbones:
        if name not in DEFAULT_BACKBONE:
            backbone_names = ", ".join(DEFAULT_BACKBONE)
            raise ConfigError(
                f"{where}.backbones: there is no '{name}'{closest(name, DEFAULT_BACKBONE)} ({backbone_names})"
            )
    for name, feature_set in spec.feature_sets.items():
        if feature_set == name and name not in (*FEATURE_SETS, "all"):
            raise ConfigError(
                f"{where}.features: there is no feature set '{name}'{closest(name, [*FEATURE_SETS, 'all'])}; a set of "
                "your own is named by its file (.toml)"
            )
    for backbone in spec.backbones:
        # One feature set suffices: values of the space act on backbone and training.
        arm = arm_of(base, backbone, next(iter(spec.feature_sets.values())))
        for key, space in (("space", applicable(spec.space, arm)), ("deferred", spec.deferred)):
            _check_values(space, arm, f"{where}.{key}", backbone, spec.widths)


def _check_values(space: Space, arm: Arm, where: str, backbone: str, widths: str) -> None:
    for name, range_ in space.items():
        # Ends of a range suffice: parts refuse values beyond a bound, not between two good ones.
        for value in range_.options if isinstance(range_, Choice) else (range_.low, range_.high):
            try:
                WIDTHS[widths](apply(arm, {name: value})).experiment("of the search")
            except (ConfigError, KeyError, TypeError, ValueError) as error:
                raise ConfigError(f"{where}.{name} = {value!r} cannot be for {backbone}: {error}") from error


def _spec(table: dict[str, object], where: str) -> SearchSpec:
    space = space_of(table.pop("space", {}), THESIS, where)
    deferred = space_of(table.pop("deferred", {}), None, where, "deferred")
    if not space:
        raise ConfigError(f"settings {where}: search.space holds no dimension; leave at least one in")
    return replace(build(SearchSpec, table, f"{where}, search"), space=space, deferred=deferred)


def space_of(
    entries: object, over: Space | None = None, where: str = "of a study", key: str = "space"
) -> dict[str, Range]:
    """Return a space from its form in a settings file, merged over another one; `key` is its name there.

    Raises:
        ConfigError: no table, an unknown dimension, or a range that holds nothing.
    """
    if not isinstance(entries, Mapping):
        raise ConfigError(f"settings {where}: search.{key} = {shown(entries)}; expected a table of dimensions")
    space = dict(over or {})
    for name, entry in entries.items():
        if name not in DIMENSIONS:
            raise ConfigError(f"settings {where}: unknown dimension 'search.{key}.{name}'{closest(name, DIMENSIONS)}")
        # `false` takes a dimension out of the preset's space.
        if entry is False:
            space.pop(name, None)
        else:
            space[name] = _range(entry, f"{where}: search.{key}.{name}")
    return space


def _range(entry: Any, where: str) -> Range:
    if isinstance(entry, Mapping):
        return build(Real, entry, where)
    try:
        if isinstance(entry, list):
            return Choice(tuple(entry))
    except ConfigError as error:
        raise ConfigError(f"settings {where}: {error}") from error
    raise ConfigError(
        f"settings {where} = {entry!r}; a list of values, a table {{ low = .., high = .., log = true }}, or false must "
        "hold"
    )


def plain_spec(spec: SearchSpec) -> dict[str, object]:
    """Return a spec as plain values, with the keys that the identity of a study has (`MOVED`)."""
    table = plain_tree(spec)
    for key, moved in MOVED.items():
        phase, name = moved.split(".")
        table[key] = table[phase].pop(name)
    for phase in {moved.partition(".")[0] for moved in MOVED.values()}:
        table |= {f"{phase}.{name}": value for name, value in table.pop(phase).items()}
    return {**table, "space": plain_space(spec.space), "deferred": plain_space(spec.deferred)}


def plain_space(space: Space) -> dict[str, object]:
    """Return a space as in a settings file."""
    return {
        name: list(dimension.options)
        if isinstance(dimension, Choice)
        else {"low": dimension.low, "high": dimension.high, "log": dimension.log}
        for name, dimension in space.items()
    }
