"""Results of a search for later commands: frozen sessions, and the networks of phase 6 as runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from edp.config.experiment import Experiment, experiment_toml
from edp.data.frozen import ByFrozen, Session
from edp.data.prepared import Prepared, prepare
from edp.evaluation.footprint import footprint
from edp.logs.source import DataSource
from edp.networks.predictor import Predictor
from edp.settings.provenance import Provenance
from edp.storage import write_json
from edp.storage.paths import full_path
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import Run, run_key
from edp.training import make_bundle, save_bundle
from edp.training.provenance import training_provenance
from edp.workflows.compression.pipeline import TEACHER
from edp.workflows.search.context import SearchContext
from edp.workflows.search.phases.compression import NAME
from edp.workflows.search.smaller import Recipe, network_of
from edp.workflows.search.trainings import Outcome, experiment_of

FOLDER, CHOSEN = "networks", "chosen"


def freeze_split(folder: Path, context: SearchContext, digests: Mapping[str, str]) -> ByFrozen:
    """Return the sessions of a search by their content, for every later command.

    Args:
        folder: folder of the study.
        context: context with the sessions set apart.
        digests: hashes of all sessions by name.
    """
    parts = (context.test, context.second, context.validation, context.training)
    test, second, validation, train = (
        tuple(Session(name=name, digest=digests[name]) for name in names) for names in parts
    )
    return ByFrozen(test=test, second_test=second, validation=validation, train=train, study=str(full_path(folder)))


def write_networks(
    folder: Path,
    source: DataSource,
    context: SearchContext,
    split: ByFrozen,
    outcomes: Sequence[Outcome],
) -> dict[str, Path]:
    """Write the networks evaluated on the second sealed test set as runs, after the decision of phase 6.

    Args:
        folder: folder of the study.
        source: source of the recordings.
        context: context with the decisions.
        split: split of the runs.
        outcomes: outcomes of the trainings evaluated there.

    Returns:
        Folder of each run; none before phase 6 has decided. Without one of its own the chosen network is the teacher.

    Raises:
        EdpError: recordings that cannot be read any more, or a folder that cannot be written.
    """
    if NAME not in context.decided or not outcomes:
        return {}
    recordings = source.read()
    written: dict[str, Path] = {}
    for outcome in outcomes:
        recipe = Recipe.from_json(outcome.order.recipe or {})
        name = TEACHER if (recipe.units, recipe.final) == (None, "float32") else CHOSEN
        experiment = replace(recipe.experiment(experiment_of(outcome.order)), split=split)
        first = recordings[0]
        task = experiment.task.resolve(first.rate_hz, first.channel_names, experiment.model.physics)
        # Scaling follows from the training sessions, not from the second test set.
        data = prepare(recordings, task, split, experiment.model.window)
        network = network_of((outcome.result or {})["weights"], task, experiment.model)
        written[name] = folder / FOLDER / name
        _write_run(written[name], network, experiment, data, _provenance(source, experiment, data, recipe))
    return written


def _write_run(
    folder: Path, network: Predictor, experiment: Experiment, data: Prepared, provenance: Provenance
) -> None:
    # The recipe is part of the key: another recipe of the same settings is another run.
    key = run_key({"experiment": experiment_toml(experiment), "made by": provenance.more["search"]}, data.digest)
    with Run.create(folder, "network", key, experiment_toml(experiment)) as run:
        write_json(run.file(PROVENANCE), provenance.to_table())
        write_json(run.file("footprint.json"), footprint(network).to_json())
        save_bundle(make_bundle(network, data, provenance), run.file("bundle"))


def _provenance(source: DataSource, experiment: Experiment, data: Prepared, recipe: Recipe) -> Provenance:
    training, split = experiment.training, experiment.split
    frozen = split.frozen if isinstance(split, ByFrozen) else {}
    provenance = training_provenance(source, data, training.seed, training.threads, 0.0, frozen)
    search = {"phase": NAME, "recipe": recipe.to_json()}
    return provenance.add_entries(regime=training.chunks.regime, device=training.device, search=search)
