"""Trials of feature sets: networks trained with equal settings on each set and evaluated on the same recordings.

What a feature set is for is the error of the model that reads it, so a proposal is held to that: beside all channels,
the usual sets, and sets of the same size drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from edp.config.experiment import Experiment, FeatureSettings, plain_tree
from edp.data.features import FEATURE_SETS, Derived
from edp.data.task import TargetMode
from edp.errors import ConfigError, closest
from edp.evaluation.scores_file import MEAN, ScoresFile, metric
from edp.evaluation.trials_file import FeatureSetTrial, PairedDifference, Trials
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import WorkUnit
from edp.logs.source import DataSource
from edp.networks.streaming import parameters_of
from edp.recording import Recording
from edp.settings.bounds import SEED, check_bounds, check_count, integer
from edp.signals import Kind
from edp.storage import make_folder
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path
from edp.training import Bundle, Diverged, TrainingProgress
from edp.workflows.train_evaluate import evaluate, train

Sets = Mapping[str, str | FeatureSettings]
OnTrial = Callable[[str, int, int, TrainingProgress | None], None]
COVERAGE = 0.95
MAX_SETS = 1_000
"""Random sets, or seeds: each of them is a training."""
# Small sets of few channels repeat themselves; the number of draws must end somewhere.
_DRAWS = 20
"""Draws for one random set that is not there already."""


@dataclass(frozen=True, kw_only=True)
class TrialSpec:
    """Trainings in addition to the given feature sets.

    Attributes:
        random_sets: sets drawn at random from the channels, of the size of the first given set.
        random_seed: seed of the draw.
        excluded_channels: channels that random sets must not hold; leaks of the future, with which any set looks good.
        seeds: a training for each set with each of these seeds.
    """

    random_sets: int = 3
    random_seed: int = 0
    excluded_channels: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        check_bounds("trials", self, random_sets=integer(0, MAX_SETS), random_seed=SEED, seeds=SEED)
        check_count("trials", "seeds", self.seeds, MAX_SETS)
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ConfigError(f"trials: seeds = {list(self.seeds)}; at least one seed, each once, must hold")


def try_feature_sets(
    source: DataSource,
    experiment: Experiment,
    sets: Sets,
    out: str | Path,
    spec: TrialSpec | None = None,
    on_trial: OnTrial | None = None,
    workers: Workers = IN_PROCESS,
) -> Trials:
    """Train the experiment's network on every set within its budget, and evaluate all on the held-out recordings.

    Trainings that are in the folder already are kept; one that was interrupted goes on.

    Args:
        source: source of the recordings.
        experiment: settings of all trainings; only features and seed change.
        sets: feature sets by name, each a name as in ``task.features`` or a table. The first set is the reference.
        out: folder of the run folders and of ``trials.json``.
        spec: random sets and seeds.
        on_trial: called with the set, how many trainings are done and of how many, and each event of the training.
        workers: who trains; nodes see recordings and `out` under the same paths.

    Raises:
        EdpError: nothing that can be tried, or a training failed; what was finished stays.
    """
    spec = spec or TrialSpec()
    # Sets are checked before the first training: an impossible one would fail after hours.
    first = source.read()[0]
    chosen, notes = _usable(sets, experiment, first)
    if not chosen:
        raise ConfigError("no feature set can be tried: " + "; ".join(notes))
    drawn = _draw_sets(chosen, experiment, first, spec)
    if len(drawn) < spec.random_sets:
        notes.append(f"{len(drawn)} of {spec.random_sets} random sets were drawn: there are no others of this size")
    chosen |= drawn
    folder = make_folder(out)
    planned = [
        _PlannedTrial.from_set(name, features, seed, experiment, folder)
        for name, features in chosen.items()
        for seed in spec.seeds
    ]
    tell = on_trial or (lambda name, done, total, event: None)
    if not workers.are_alone:
        units = [_unit(trial, source.visible_to(workers)) for trial in planned]
        for done, (number, _) in enumerate(workers.map(units), start=1):
            tell(planned[number].name, done, len(planned), None)
    finished: dict[str, list[_Finished]] = {}
    for done, trial in enumerate(planned):
        tell(trial.name, done, len(planned), None)
        bundle = _train_trial(source, trial, partial(tell, trial.name, done, len(planned)))
        finished.setdefault(trial.name, []).append(_Finished.from_bundle(bundle, trial.run))
    trials = _tabulate_trials(finished, notes, experiment.task.horizons)
    trials.write(folder)
    return trials


@dataclass(frozen=True)
class _PlannedTrial:
    """Training of one feature set with one seed: name of the set, settings, and run folder."""

    name: str
    settings: Experiment
    run: Path

    @staticmethod
    def from_set(
        name: str, features: str | FeatureSettings, seed: int, experiment: Experiment, folder: Path
    ) -> _PlannedTrial:
        task, training = replace(experiment.task, features=features), replace(experiment.training, seed=seed)
        return _PlannedTrial(
            name, replace(experiment, task=task, training=training), folder / f"{_slug(name)}_seed{seed}"
        )


def _train_trial(
    source: DataSource, trial: _PlannedTrial, on_event: Callable[[TrainingProgress], None] | None = None
) -> Bundle:
    """Train and evaluate the network of a trial, or read the existing one."""
    bundle = train(source, trial.settings, trial.run, on_event)
    # Persistence alone: the sets are compared with each other, other baselines cost minutes each.
    evaluate(trial.run, baselines=["persistence"])
    return bundle


def _unit(trial: _PlannedTrial, source: DataSource) -> WorkUnit:
    arguments = {"experiment": plain_tree(trial.settings)}
    where = {"source": source, "trial": replace(trial, run=full_path(trial.run))}
    return WorkUnit(f"{__name__}:train_unit", f"feature set '{trial.name}'", arguments, source.content_key(), where)


def train_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, str]:
    """Train the network of a trial into its run folder."""
    try:
        _train_trial(where["source"], where["trial"])
    except Diverged as end:
        return {"diverged": str(end)}
    return {}


def add_differences(settings: FeatureSettings, recording: Recording, name: str) -> FeatureSettings:
    """Return the set with tick-to-tick changes of its cylinder pressures, as in FG2 (eq. 3.1)."""
    derived_sources = {entry.source for entry in settings.derived}
    candidates = [c for c in settings.channels if c not in derived_sources]
    pressures = [c for c in candidates if recording.channels[recording.index(c)].kind is Kind.PRESSURE]
    added = tuple(Derived(f"d{c}", c, "difference", Kind.PRESSURE) for c in pressures)
    return replace(settings, name=name, derived=settings.derived + added)


def _usable(sets: Sets, experiment: Experiment, first: Recording) -> tuple[dict[str, str | FeatureSettings], list[str]]:
    """Return the sets whose channels are all present, with targets if required, and notes on the others."""
    notes: list[str] = []
    chosen: dict[str, str | FeatureSettings] = {}
    for name, features in sets.items():
        if isinstance(features, str) and features != "all" and features not in FEATURE_SETS:
            raise ConfigError(f"there is no feature set '{features}'{closest(features, [*FEATURE_SETS, 'all'])}")
        if isinstance(features, FeatureSettings) and experiment.task.mode is TargetMode.DELTA:
            features, added = _add_targets(features, experiment.task.targets)
            if added:
                notes.append(
                    f"{name}: {', '.join(added)} added, because mode = 'delta' needs the targets' present values"
                )
        inputs = _inputs(features, first)
        missing = [channel for channel in inputs if channel not in first.channel_names]
        if missing:
            notes.append(f"{name} was not tried: the recordings lack {', '.join(missing)}")
        else:
            chosen[name] = features  # impossible sets are notes, not errors
    return chosen, notes


def _inputs(features: str | FeatureSettings, first: Recording) -> tuple[str, ...]:
    if isinstance(features, FeatureSettings):
        return features.channels + features.hidden
    return first.channel_names if features == "all" else FEATURE_SETS[features].inputs


def _add_targets(features: FeatureSettings, targets: Sequence[str]) -> tuple[FeatureSettings, list[str]]:
    derived = {entry.name for entry in features.derived}
    added = [target for target in targets if target not in features.channels and target not in derived]
    return replace(features, channels=(*added, *features.channels)), added


def _draw_sets(
    chosen: Mapping[str, str | FeatureSettings], experiment: Experiment, first: Recording, spec: TrialSpec
) -> dict[str, str | FeatureSettings]:
    """Return random sets with the number of channels of the first set, all different.

    In delta mode the targets are always among them.
    """
    first_inputs = _inputs(next(iter(chosen.values())), first)
    size = len(first_inputs)
    always = experiment.task.targets if experiment.task.mode is TargetMode.DELTA else ()
    free = [name for name in first.channel_names if name not in {*always, *spec.excluded_channels}]
    rng = np.random.default_rng(spec.random_seed)
    drawn: dict[str, str | FeatureSettings] = {}
    # The first set itself would be no random one.
    drawn_sets = {frozenset(first_inputs)}
    for _ in range(_DRAWS * spec.random_sets):
        picked = sorted(rng.choice(len(free), max(0, min(size - len(always), len(free))), replace=False))
        channels = (*always, *(free[i] for i in picked))
        if frozenset(channels) not in drawn_sets:
            drawn_sets.add(frozenset(channels))
            name = f"random {len(drawn) + 1}"
            drawn[name] = FeatureSettings(name=name, channels=channels)
        if len(drawn) == spec.random_sets:
            break
    return drawn


def _slug(name: str) -> str:
    """Return a name that is valid on any file system."""
    return "".join(c if c.isalnum() else "_" for c in name)


@dataclass(frozen=True)
class _Finished:
    """Facts of a finished run."""

    channels: tuple[str, ...]
    features: int
    parameters: int
    seconds: float
    scores: ScoresFile

    @staticmethod
    def from_bundle(bundle: Bundle, run: Path) -> _Finished:
        return _Finished(
            bundle.task.inputs,
            len(bundle.task.features.features),
            parameters_of(bundle.predictor),
            bundle.provenance.seconds or 0.0,
            ScoresFile.read(run),
        )


def _tabulate_trials(
    finished: Mapping[str, Sequence[_Finished]], notes: Sequence[str], horizons: Sequence[int]
) -> Trials:
    """Return the table of the stored scores."""
    ahead = [str(horizon) for horizon in horizons]
    names = list(finished)
    by_recording = {name: _recordings(finished[name], ahead) for name in names}
    trials = []
    for name in names:
        models = [run.scores.models["network"] for run in finished[name]]
        by_seed = {h: tuple(metric(m.overall[h][MEAN], "mae") for m in models) for h in ahead}
        difference = None
        # An interval needs two recordings at least.
        if name != names[0] and len(by_recording[name][ahead[0]]) > 1:
            difference = {h: _difference(by_recording[name][h], by_recording[names[0]][h]) for h in ahead}
        one = finished[name][0]
        trials.append(
            FeatureSetTrial(
                name,
                one.channels,
                one.features,
                one.parameters,
                {h: float(np.mean(values)) for h, values in by_seed.items()},
                by_seed,
                difference,
                sum(run.seconds for run in finished[name]),
            )
        )
    scores = finished[names[0]][0].scores
    persistence = {h: metric(scores.models["persistence"].overall[h][MEAN], "mae") for h in ahead}
    units = {target.unit for target in scores.targets}
    unit = units.pop() if len(units) == 1 else "mixed units"
    return Trials(tuple(trials), persistence, unit, tuple(by_recording[names[0]][ahead[0]]), tuple(notes))


def _recordings(runs: Sequence[_Finished], ahead: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the error by horizon and recording, mean over seeds."""
    each = [run.scores.models["network"].recordings for run in runs]
    return {
        h: {name: float(np.mean([metric(one[name][h][MEAN], "mae") for one in each])) for name in each[0]}
        for h in ahead
    }


def _difference(ours: Mapping[str, float], reference: Mapping[str, float]) -> PairedDifference:
    """Return the paired over recordings, with Student's t."""
    gaps = np.array([ours[name] - reference[name] for name in reference])
    mean = float(gaps.mean())
    # Pairs by recording: recordings differ more than feature sets do.
    reach = float(stdtrit(len(gaps) - 1, 0.5 + COVERAGE / 2)) * float(gaps.std(ddof=1)) / math.sqrt(len(gaps))
    return PairedDifference(mean, mean - reach, mean + reach)
