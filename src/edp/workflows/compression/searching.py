"""Search of the best network for a controller: width, pruning, number formats, quantisation-aware training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.config.experiment import Change, Experiment, experiment_toml, plain_tree
from edp.data.frozen import SECOND_TEST_SET, ByFrozen
from edp.data.prepared import Prepared
from edp.errors import ConfigError, closest
from edp.evaluation.compression import ComparedTask, CompressedRow, CompressionResult, HeldOutTest, RecordingCounts
from edp.evaluation.controller import Budget
from edp.logs.source import DataSource
from edp.networks.narrow import width_of
from edp.networks.predictor import Predictor
from edp.progress import SILENT, Progress
from edp.settings.bounds import MAX_NAMES, MAX_UNITS, check_bounds, check_count, integer, shown
from edp.signals import KINDS
from edp.storage import make_folder, read_object
from edp.storage.ledger import Ledger, Opening
from edp.storage.paths import is_file_at
from edp.storage.runs import Run, check_claimable, run_key
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.training.progress_steps import training_steps
from edp.training.strategy import DirectFit, TrainingStrategy
from edp.workflows.compression.bench import Bench, CompressionRequest
from edp.workflows.compression.distil import order_facts, read_frozen_sessions, read_run
from edp.workflows.compression.formats import FORMATS
from edp.workflows.compression.pipeline import (
    TEACHER,
    Evaluator,
    NetworkResult,
    choose,
    formats_of,
    on_validation,
    relative_error,
    rows_of,
)
from edp.workflows.compression.planning import RECIPES, CompressionPlan, make_plan
from edp.workflows.compression.variants import VARIANTS
from edp.workflows.train_evaluate import StrategyFactory, prepare_data, train

TEST_PART = "test"
THESIS_VARIANTS = {"A_u32": 32, "A_u64": 64, "B_LPTQ": 64, "C_QAT": 0, "C_u64_QAT": 64}
"""Width of the students of Table 4.9; 0 where the teacher keeps its own."""


@dataclass(frozen=True, kw_only=True)
class CompressionSearchSpec:
    """Table ``[compress]``: the alternatives of the search.

    Attributes:
        budget: limits of the controller.
        units: widths; none given, they are planned from the budget.
        formats: number formats; none given, all.
        recipes: training recipes of each width, from `edp.workflows.compression.planning.RECIPES`.
        thesis: also make the variants of Table 4.9 that are narrower than the teacher.

    Raises:
        ConfigError: a value out of range, or an unknown format or recipe.
    """

    budget: Budget = field(default_factory=Budget)
    units: tuple[int, ...] = ()
    formats: tuple[str, ...] = ()
    recipes: tuple[str, ...] = RECIPES
    thesis: bool = False

    def __post_init__(self) -> None:
        check_count("compress", "units", self.units, MAX_NAMES)
        check_bounds("compress", self, units=integer(1, MAX_UNITS))
        check_count("compress", "recipes", self.recipes, len(RECIPES), least=1)
        for key, names, known_names in (("formats", self.formats, FORMATS), ("recipes", self.recipes, RECIPES)):
            for name in names:
                if name not in known_names:
                    raise ConfigError(f"compress: {key} = {shown(name)}{closest(name, known_names)}")


@dataclass(frozen=True, kw_only=True)
class CompressionSearchRequest:
    """Request to compress a run.

    Attributes:
        spec: alternatives of the search.
        again: open the sealed test set again for another choice, which weakens what it can show; it is recorded.
        changes: settings of the trainings that differ from the run's: ``key.path=value``, or tables.
    """

    spec: CompressionSearchSpec = field(default_factory=CompressionSearchSpec)
    again: bool = False
    changes: tuple[Change, ...] = ()


class DiskBench(Bench):
    """Bench with run folders: finished trainings are read, unfinished ones continue.

    Args:
        teacher: the trained network.
        data: series to train on.
        experiment: settings of the teacher's run.
        source: source of the recordings.
        folder: folder for the runs.

    Attributes:
        networks: stage of the progress whose units are networks.
    """

    def __init__(
        self,
        teacher: Predictor,
        data: Prepared,
        experiment: Experiment,
        source: DataSource,
        folder: Path,
    ) -> None:
        super().__init__(teacher, data, experiment.training)
        self.frozen: Mapping[str, str] = {}
        self.experiment, self.source, self.folder = experiment, source, folder
        self.networks: Progress = SILENT
        self.done = 0

    def train(self, order: CompressionRequest, start: Predictor | None) -> Predictor:
        """Carry out an order as a run, or read the run."""
        facts = order_facts(order) | {"teachers": [weights_digest(self.teacher)]}
        facts |= {"start": None if start is None else weights_digest(start)}
        run = self.folder / order.name
        self.done += 1
        # A finished run with the same facts is read: a search that goes on trains nothing twice.
        status = read_object(run / "status.json", ("status",))["status"] if is_file_at(run / "status.json") else ""
        if status == "finished":
            bundle = load_bundle(run)
            if bundle.provenance.more.get("strategy") == facts:
                self.networks.step(self.done)
                return bundle.predictor

        def strategy(data: Prepared) -> TrainingStrategy | DirectFit:
            return order.strategy([self.teacher], data, start)

        model, training = order.model(self.teacher.spec), order.training(self.training)
        student_experiment = replace(self.experiment, model=model, training=training)
        self.networks.note(order.name)
        strategy_factory = StrategyFactory(facts, strategy, self.frozen)
        listener = training_steps(self.networks)
        bundle = train(self.source, student_experiment, run, listener, strategy_factory, self.data)
        self.networks.step(self.done)
        return bundle.predictor


def search(
    run: str | Path,
    request: CompressionSearchRequest,
    out: str | Path,
    source: DataSource | None = None,
    progress: Progress = SILENT,
) -> CompressionResult:
    """Train smaller networks of a run, evaluate them in their formats, and choose the best within a budget.

    Choices rest on the validation part. The test part is opened once, for the chosen network and the teacher; that is
    recorded in the folder. For a run of a model search it is the second test set of the search, and the opening is
    recorded in its ledger, too. The same call goes on after a stop, and trains nothing twice.

    Args:
        run: run folder of the teacher.
        request: run, budget and alternatives.
        out: folder of the search, with a run for each network.
        source: recordings to learn, choose and evaluate on; by default those of the run.
        progress: receiver of the progress; its units are networks.

    Raises:
        EdpError: not a run, a budget that no network meets, other settings or data in `out`, or a test set that was
            opened for another choice.
    """
    check_claimable(out, "compression")
    spec = request.spec
    teacher, experiment, own = read_run(run, request.changes)
    plan = make_plan(teacher, spec.budget, spec.units, spec.formats, spec.recipes)
    for note in plan.notes:
        progress.note(note)
    frozen = read_frozen_sessions(run, experiment)
    data = prepare_data(source or own, experiment, frozen)
    held_out = _find_sealed(source or own, experiment, data)
    # The judge changes no weights; its settings stay out of the key.
    settings = {key: value for key, value in plain_tree(experiment).items() if key != "evaluation"}
    key = run_key(settings | {"teacher": weights_digest(teacher)}, data.digest)
    with Run.create(out, "compression", key, experiment_toml(experiment)) as folder:
        bench = DiskBench(teacher, data, experiment, source or own, make_folder(folder.file("runs")))
        bench.frozen = frozen
        comparison = _Comparison(bench, spec.budget, Path(run))
        comparison.make_all(plan, spec, progress)
        front, chosen = choose(comparison.rows)
        units = sorted({KINDS[kind].report_unit for kind in data.target_kinds})
        result = CompressionResult(
            budget=spec.budget,
            task=ComparedTask(data.task.horizons, data.task.rate_hz),
            unit=units[0] if len(units) == 1 else "mixed units",
            recordings=RecordingCounts(len(data.train), len(data.validation), len(held_out.data.test)),
            teacher=comparison.teacher,
            rows=tuple(comparison.rows),
            front=tuple(front),
            chosen=chosen,
            notes=(*plan.notes, *comparison.notes),
        )
        test = HeldOutTest()
        if result.best is not None:
            test = comparison.open_test_set(result.best, folder, held_out, request.again)
        # The test part of the same data that `edp evaluate` has judged is no sealed set any more.
        same_data = held_out.name == TEST_PART and (source is None or source.to_dict() == own.to_dict())
        seen = same_data and is_file_at(Path(run) / "scores.json")
        test = replace(test, seen_before=held_out.opened_before or len(test.openings) > 1 or seen)
        result = replace(result, held_out_test=test)
        result.write(folder.path)
    return result


@dataclass(frozen=True, eq=False)
class _SealedRecordings:
    """Recordings that are evaluated on once.

    Attributes:
        data: they are its test part.
        name: name of the sealed test set.
        study: folder of the model search that set it apart and records openings; None where none did, or it is gone.
        opened_before: whether a model search evaluated networks on it already.
    """

    data: Prepared
    name: str = TEST_PART
    study: Path | None = None
    opened_before: bool = False


def _find_sealed(source: DataSource, experiment: Experiment, data: Prepared) -> _SealedRecordings:
    """Return the second test set of the model search that a run comes from, otherwise the test part."""
    split = experiment.split
    if not isinstance(split, ByFrozen):
        return _SealedRecordings(data)
    # Sessions count by content: a renamed file is still the same recording.
    there = {recording.digest for recording in source.read()}
    if not any(session.digest in there for session in split.second_test):
        return _SealedRecordings(data, opened_before=any(session.digest in there for session in split.test))
    study = Path(split.study)
    recorded = split.study and is_file_at(study / "study.json") and is_file_at(study / "ledger" / "about.json")
    opened = prepare_data(source, replace(experiment, split=split.opened()))
    return _SealedRecordings(opened, SECOND_TEST_SET, study if recorded else None)


class _Comparison:
    """Networks of a bench, compared on the validation part.

    Args:
        bench: makes the networks.
        budget: limits of the controller.
        run: folder of the teacher.

    Attributes:
        teacher: the teacher in float32.
        rows: every network in every format that it can be in.
        notes: omitted formats, each with the reason.
    """

    def __init__(self, bench: DiskBench, budget: Budget, run: Path) -> None:
        self.bench, self.run = bench, run
        self.evaluator = Evaluator(on_validation(bench.data), budget)
        first = self.evaluator.evaluate(bench.teacher, ["float32"])
        self.teacher = replace(rows_of(None, first, first.plain, str(run))[0], name=TEACHER)
        self.rows: list[CompressedRow] = []
        self.notes: list[str] = []
        self._networks = {TEACHER: bench.teacher}

    def make_all(self, plan: CompressionPlan, spec: CompressionSearchSpec, progress: Progress) -> None:
        """Make the networks of a plan, and the variants of the thesis that are narrower than the teacher."""
        full = width_of(self.bench.teacher.spec)
        variants = [name for name, units in THESIS_VARIANTS.items() if spec.thesis and units < full]
        self.bench.networks = progress.stage("network", plan.trainings + len(variants))
        requests = [order for orders in plan.orders.values() for order in orders]
        results = self._evaluate_all(requests, plan)
        errors = {order: relative_error(result.plain, self.teacher.scores) for order, result in results.items()}
        results |= self._evaluate_all(plan.to_round(errors), plan)
        self._add(None, self.evaluator.evaluate(self.bench.teacher, plan.formats), self.bench.teacher)
        for order in sorted(results, key=lambda order: -order.units):
            self._add(order, results[order], self.bench.network(order))
        for name in variants:
            variant = VARIANTS[name](self.bench)
            result = self.evaluator.evaluate(variant.network, [variant.number_format], variant.parameter_bytes)
            self._add(variant.order, result, variant.network, name)

    def _evaluate_all(
        self, requests: Sequence[CompressionRequest], plan: CompressionPlan
    ) -> dict[CompressionRequest, NetworkResult]:
        return {
            order: self.evaluator.evaluate(self.bench.network(order), formats_of(order, plan.formats))
            for order in requests
        }

    def _add(
        self, order: CompressionRequest | None, result: NetworkResult, network: Predictor, variant: str = ""
    ) -> None:
        """Add the rows of a network; rows of a thesis variant have its name."""
        run = self.run if order is None else self.bench.folder / order.name
        for row in rows_of(order, result, self.teacher.scores, str(run)):
            self.rows.append(replace(row, name=variant or row.name))
            self._networks[self.rows[-1].name] = network
        name = TEACHER if order is None else order.name
        self.notes += [f"{name} in {FORMATS[key].label}: {reason}" for key, reason in result.left_out.items()]

    def open_test_set(self, best: CompressedRow, folder: Run, held_out: _SealedRecordings, again: bool) -> HeldOutTest:
        """Evaluate the teacher and the chosen network on the sealed test set; the opening is recorded before."""
        pair = {TEACHER: self.teacher, "chosen": best}
        # Weights and format are the key of an opening: the same pair may be evaluated again without a second look.
        keys = [f"{weights_digest(self._networks[row.name])} {row.number_format}" for row in pair.values()]
        why = "the network chosen by edp compress search, and its teacher"
        openings: list[Opening] = []
        # The ledger of the search comes first: it knows of openings from other folders.
        for ledger_folder in [*([held_out.study / "ledger"] if held_out.study else []), folder.file("ledger")]:
            with Ledger(ledger_folder) as ledger:
                opening = ledger.open_test_set(held_out.name, keys, why, again)
                openings = openings or ledger.openings(held_out.name)
        # Ranges of activations come from the series that the networks were trained on.
        evaluator = Evaluator(replace(held_out.data, train=self.bench.data.train), self.evaluator.budget)
        scores = {
            name: evaluator.evaluate(self._networks[row.name], [row.number_format]).formats[row.number_format].scores
            for name, row in pair.items()
        }
        return HeldOutTest(
            name=held_out.name,
            opened=opening.time,
            openings=tuple(openings),
            scores=scores,
            error=relative_error(scores["chosen"], scores[TEACHER]),
        )
