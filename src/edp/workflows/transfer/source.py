"""Start of a transfer: a trained network, the settings of its run, and its recordings if available."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from edp.config.experiment import (
    Change,
    Experiment,
    FeatureSettings,
    TaskSettings,
    build,
    load_experiment,
    merged,
    override,
    plain_tree,
)
from edp.data.features import FEATURE_SETS
from edp.data.prepared import Prepared
from edp.data.splits import ByTime
from edp.data.task import Task
from edp.errors import BundleError, ConfigError, EdpError
from edp.networks.predictor import Predictor
from edp.settings.tree import combined, value_at
from edp.storage.paths import is_file_at
from edp.training import Bundle, load_bundle
from edp.training.bundle import weights_digest
from edp.workflows.train_evaluate import read_trained_run

OWN = ("training.epochs", "training.optimizer", "training.patience", "training.refit", "training.chunks.batch")
"""Settings that a fine-tuning has others for, in the table ``[finetune]``."""
PLACES = ("training", "split", "evaluation")


@dataclass(frozen=True, eq=False)
class SourceModel:
    """Trained network with its origin.

    Attributes:
        bundle: the network with what it reads.
        experiment: settings of its run; those of the preset ``standard`` for a bundle alone.
        data: its recordings, as its run divided them; None where they cannot be read.
        absent: why there are no recordings; empty where there are.
    """

    bundle: Bundle
    experiment: Experiment
    data: Prepared | None
    absent: str = ""

    @property
    def predictor(self) -> Predictor:
        """The network, in evaluation mode."""
        return self.bundle.predictor

    @property
    def frozen(self) -> dict[str, str]:
        """Names by digest of sessions that a model search set apart for good."""
        return dict(self.bundle.provenance.origin.frozen)

    @property
    def facts(self) -> dict[str, object]:
        """Return its identity."""
        digest = None if self.data is None else self.data.digest
        return {"weights": weights_digest(self.predictor), "recordings": digest}


def read_source(path: str | Path, recordings: bool = True) -> SourceModel:
    """Read the source of a run folder, of the run that holds a bundle, or of a bundle alone.

    Args:
        path: path of the folder.
        recordings: read what it was trained on, too.

    Raises:
        BundleError: not a bundle, or one of an integer network (W8A16).
    """
    folder = Path(path)
    # A bundle inside of its run folder finds the run beside it.
    if is_file_at(folder.parent / "config.toml") and not is_file_at(folder / "config.toml"):
        folder = folder.parent
    bundle = load_bundle(path)
    if bundle.predictor.number_format != "float32":
        raise BundleError(
            f"'{path}' is a network in {bundle.predictor.number_format}, which cannot be trained on; give the run in "
            "float32 that it was made of, and quantise what comes out"
        )
    if not is_file_at(folder / "config.toml"):
        return SourceModel(
            bundle, load_experiment(), None, f"'{path}' is a bundle without the run that it was trained in"
        )
    experiment = load_experiment(folder / "config.toml", None)
    if not recordings:
        return SourceModel(bundle, experiment, None, "its recordings were not asked for")
    try:
        return SourceModel(bundle, experiment, read_trained_run(folder)[3])
    # Missing or changed recordings do not prevent a transfer; methods that need them are left out.
    except EdpError as error:
        return SourceModel(bundle, experiment, None, str(error))


def target_experiment(source: SourceModel, changes: Sequence[Change] = ()) -> Experiment:
    """Return settings for logs of a target: the source's task and network, each log divided by time, and `changes`.

    An epoch is a pass over the training parts, however long the source's epochs were, unless a change says otherwise.

    Raises:
        ConfigError: a change of what a transfer keeps, or of what the table ``[finetune]`` settles.
    """
    layers = [override(change) for change in changes]
    for layer in layers:
        _check_kept(layer)
    task = task_settings(source.bundle.task)
    # Zero: passes over the target's logs, not the number of updates that suited the source.
    training = replace(source.experiment.training, updates=0)
    experiment = replace(source.experiment, task=task, split=ByTime(), model=source.predictor.spec, training=training)
    table = plain_tree(experiment)
    return build(Experiment, merged(table, combined(layers)), "of the source with --set")


def _check_kept(layer: Mapping[str, object]) -> None:
    """Refuse changes of task and network, which give weights their meaning, and of values of ``[finetune]``."""
    for name in layer:
        if name not in PLACES:
            raise ConfigError(
                f"{name}: a transfer keeps task and network of its source; settings of {', '.join(PLACES)} can be "
                "changed, and those of finetune"
            )
    for path in OWN:
        if value_at(layer, path) is not None:
            raise ConfigError(f"{path}: a fine-tuning has settings of its own for it, in its table [finetune]")


def task_settings(task: Task) -> TaskSettings:
    """Return settings that resolve to a task, with features by name if the name determines them."""
    feature_settings: str | FeatureSettings = task.features.name
    # A name may stand for another set by now; then the channels are listed.
    if FEATURE_SETS.get(task.features.name) != task.features:
        feature_settings = FeatureSettings(
            **{entry.name: getattr(task.features, entry.name) for entry in fields(FeatureSettings)}
        )
    return TaskSettings(
        features=feature_settings,
        targets=task.targets,
        horizons=task.horizons,
        mode=task.mode,
        derived_targets=task.derived_targets,
        integrate=task.integrate,
    )
