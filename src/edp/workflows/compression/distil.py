"""From a run to a run of a smaller network that learned from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from edp.config.experiment import Change, Experiment, load_experiment, plain_tree
from edp.data.frozen import keep_frozen, list_frozen, refuse_frozen
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.unlabelled import unlabelled
from edp.errors import ConfigError, StorageError
from edp.logs.source import DataSource
from edp.networks.losses import LOSSES
from edp.networks.predictor import Predictor
from edp.progress import SILENT, Progress
from edp.settings.bounds import MAX_LEVELS, MAX_UNITS, check_bounds, integer
from edp.settings.provenance import read_provenance
from edp.settings.tree import SettingsTree
from edp.storage.paths import is_file_at
from edp.storage.runs import check_claimable
from edp.training import Bundle, load_bundle
from edp.training.bundle import weights_digest
from edp.training.compression.distillation import DistillationSpec
from edp.training.compression.qat import RoundingSpec
from edp.training.progress_steps import training_steps
from edp.training.spec import TrainingSpec
from edp.training.strategy import DirectFit, TrainingStrategy
from edp.workflows.compression.bench import CompressionRequest
from edp.workflows.train_evaluate import StrategyFactory, train

DISTIL_SETTINGS = SettingsTree({"distillation_loss": LOSSES})
"""Reads the table ``[distil]``, whose objective holds a registered loss."""


@dataclass(frozen=True, kw_only=True)
class DistilSpec:
    """Table ``[distil]``: a student and its training.

    Attributes:
        units: width of the student.
        levels: convolution levels; None for one less than the teacher has.
        pruned: begin with what pruning leaves of the teacher.
        objective: loss in chunks; None for the default, and for rows of a committee's bank.

    Raises:
        ConfigError: a value out of range, or a pruned student with levels of its own.
    """

    units: int
    levels: int | None = None
    pruned: bool = False
    objective: DistillationSpec | None = None

    def __post_init__(self) -> None:
        check_bounds("distil", self, units=integer(1, MAX_UNITS), levels=integer(1, MAX_LEVELS))
        if self.pruned and self.levels is not None:
            raise ConfigError("a pruned student keeps all levels of its teacher; leave out the levels, or the pruning")


@dataclass(frozen=True, kw_only=True)
class DistilRequest:
    """Request to distil a run.

    Attributes:
        spec: the student, and how it is taught.
        teachers: run folders or bundles of further teachers.
        further: source of recordings without measured targets; the student is trained on the teachers' predictions for
            them.
        changes: settings of the training that differ from the run's: ``key.path=value``, or tables.
    """

    spec: DistilSpec
    teachers: tuple[str, ...] = ()
    further: DataSource | None = None
    changes: tuple[Change, ...] = ()


def distil(
    run: str | Path,
    request: DistilRequest,
    out: str | Path,
    source: DataSource | None = None,
    progress: Progress = SILENT,
) -> Bundle:
    """Train a student of a run and write a run folder; an interrupted training continues.

    Args:
        run: run folder of the teacher.
        request: student and its training.
        out: run folder of the student.
        source: recordings to learn on; by default those of the run.
        progress: receiver of the progress; its units are epochs.

    Raises:
        EdpError: not a run, a student that is no smaller, teachers that contradict one another, other data or settings
            in `out`.
    """
    check_claimable(out, "network")
    spec = request.spec
    teacher, experiment, own = read_run(run, request.changes)
    order = CompressionRequest(
        name="student", units=spec.units, levels=spec.levels, pruned=spec.pruned, distillation=spec.objective
    )
    model = order.model(teacher.spec)
    # The teacher under another name would train for nothing.
    if model == teacher.spec:
        raise ConfigError(f"a student of {spec.units} units is the teacher itself; take fewer units or levels")
    teachers = [teacher, *(load_bundle(path).predictor for path in request.teachers)]
    frozen = read_frozen_sessions(run, experiment)
    series, digests = _read_unlabelled(teacher, request.further, frozen)
    facts = order_facts(order) | {"teachers": [weights_digest(net) for net in teachers], "further": digests}

    def strategy(data: Prepared) -> TrainingStrategy | DirectFit:
        return order.strategy(teachers, data, None, series)

    if order.on_rows(teachers):
        _refuse_settings_of_chunks(experiment.training, read_run(run)[1].training)
    student_experiment = replace(experiment, model=model, training=order.training(experiment.training))
    strategy_factory = StrategyFactory(facts, strategy, frozen)
    return train(source or own, student_experiment, out, training_steps(progress), strategy_factory)


def _refuse_settings_of_chunks(asked: TrainingSpec, before: TrainingSpec) -> None:
    """Refuse settings that a training on rows does not read."""
    read = {"seed", "threads"}
    changed = [
        part.name
        for part in fields(TrainingSpec)
        if part.name not in read and getattr(asked, part.name) != getattr(before, part.name)
    ]
    if changed:
        raise ConfigError(
            f"training.{', training.'.join(changed)}: the student of a committee learns on rows of its bank, and reads "
            "training.seed and training.threads alone; leave them out, or give an objective to train in chunks, for "
            "example --set distil.objective.target_weight=0.5"
        )


def read_run(run: str | Path, changes: Sequence[Change] = ()) -> tuple[Predictor, Experiment, DataSource]:
    """Return network, settings and recordings of a run, or of the run that holds a bundle.

    Raises:
        EdpError: not a run folder.
    """
    folder = _run_folder(run)
    bundle = load_bundle(folder)
    for name in ("config.toml", "provenance.json"):
        if not is_file_at(folder / name):
            raise StorageError(
                f"'{folder}' is not a run folder: it has no {name}, which says how the network was trained; give the "
                "folder of edp train"
            )
    experiment = load_experiment(folder / "config.toml", None, changes)
    before = load_experiment(folder / "config.toml", None)
    # A student of another task could not be compared with its teacher.
    if experiment.task != before.task or experiment.model != bundle.predictor.spec:
        raise ConfigError(
            "settings of the task or the model cannot be changed here: a student has those of its teacher"
        )
    # Frozen sessions were judged once; a student that trains on them would make the test part worthless.
    keep_frozen(before.split, experiment.split)
    return bundle.predictor, experiment, DataSource.from_dict(read_provenance(folder).origin.reader)


def read_frozen_sessions(run: str | Path, experiment: Experiment) -> dict[str, str]:
    """Return names by digest of frozen sessions for descendants of a run, from its split and earlier runs."""
    return {**read_provenance(_run_folder(run)).origin.frozen} | list_frozen(experiment.split)


def _run_folder(run: str | Path) -> Path:
    """Return the folder of a run, or of the run that holds a bundle."""
    folder = Path(run)
    # Both a run folder and the bundle inside it are accepted.
    inside = is_file_at(folder.parent / "config.toml") and not is_file_at(folder / "config.toml")
    return folder.parent if inside else folder


def order_facts(order: CompressionRequest) -> dict[str, object]:
    """Return the plain values that determine the training of a request."""
    spec = order.distillation
    plain = None if spec is None else asdict(spec) | {"distillation_loss": _loss(spec)}
    rounding: RoundingSpec | None = order.rounding
    return {
        "units": order.units,
        "levels": order.levels,
        "pruned": order.pruned,
        "distillation": plain,
        "rounding": None if rounding is None else asdict(rounding),
    }


def _loss(spec: DistillationSpec) -> Any:
    """Return the soft loss with its name; an unregistered loss, such as the softmax form, by its class."""
    # Losses of a distillation need not be registered: the class name stands for them in the key.
    name = next(
        (key for key, kind in LOSSES.items() if kind is type(spec.distillation_loss)),
        type(spec.distillation_loss).__name__,
    )
    return {"kind": name} | {key: plain_tree(value) for key, value in vars(spec.distillation_loss).items()}


def _read_unlabelled(
    teacher: Predictor, source: DataSource | None, frozen: dict[str, str]
) -> tuple[list[Series], list[str]]:
    recordings = [] if source is None else source.read()
    refuse_frozen(recordings, frozen, "the student would learn from it")
    return [unlabelled(teacher.task, entry) for entry in recordings], [entry.digest for entry in recordings]
