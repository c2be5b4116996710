"""The best network that a controller can run: width, pruning, number formats and training with rounded numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from edp.config.experiment import Change, Experiment, experiment_toml, plain_tree
from edp.data.frozen import SECOND_TEST_SET, ByFrozen
from edp.data.prepared import Prepared
from edp.errors import ConfigError, ExportError, closest
from edp.evaluation.controller import Budget
from edp.logs.source import DataSource
from edp.networks.narrow import width_of
from edp.networks.predictor import Predictor
from edp.progress import SILENT, Progress
from edp.settings.bounds import MOST_NAMES, MOST_UNITS, check_bounds, check_count, integer, shown
from edp.signals import KINDS
from edp.storage import make_folder, read_object, write_json
from edp.storage.ledger import Ledger
from edp.storage.paths import is_file_at
from edp.storage.runs import Run, check_claimable, run_key
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.training.progress_steps import training_steps
from edp.training.strategy import DirectFit, TrainingStrategy
from edp.workflows.compression.bench import Bench, CompressionRequest
from edp.workflows.compression.distil import frozen_sessions, order_facts, read_run
from edp.workflows.compression.formats.base import FORMATS, Deployed, deploy
from edp.workflows.compression.judged import (
    CompressionResult,
    Judged,
    choose,
    deployed_row,
    measure,
    on_validation,
    relative,
)
from edp.workflows.compression.planning import RECIPES, CompressionPlan, make_plan
from edp.workflows.compression.variants import VARIANTS, CompressedCandidate
from edp.workflows.train_evaluate import StrategyFactory, prepare_data, train

TEST_PART = "test"
THESIS_VARIANTS = {"A_u32": 32, "A_u64": 64, "B_LPTQ": 64, "C_QAT": 0, "C_u64_QAT": 64}
"""Width of the students of Table 4.9; 0 where the teacher keeps its own."""
RESULT = "compression.json"


@dataclass(frozen=True, kw_only=True)
class CompressionSearchSpec:
    """The table ``[compress]``: what is searched.

    Attributes:
        budget: what the controller grants.
        units: widths; none given, they are planned from the budget.
        formats: number formats; none given, all.
        recipes: how each width is made, some of `edp.workflows.compression.planning.RECIPES`.
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
        check_count("compress", "units", self.units, MOST_NAMES)
        check_bounds("compress", self, units=integer(1, MOST_UNITS))
        check_count("compress", "recipes", self.recipes, len(RECIPES), least=1)
        for key, names, known_names in (("formats", self.formats, FORMATS), ("recipes", self.recipes, RECIPES)):
            for name in names:
                if name not in known_names:
                    raise ConfigError(f"compress: {key} = {shown(name)}{closest(name, known_names)}")


@dataclass(frozen=True, kw_only=True)
class CompressionSearchRequest:
    """What is made of a run.

    Attributes:
        spec: what is searched.
        again: open the sealed test set again for another choice, which weakens what it can show; it is recorded.
        changes: settings of the trainings that differ from the run's: ``key.path=value``, or tables.
    """

    spec: CompressionSearchSpec = field(default_factory=CompressionSearchSpec)
    again: bool = False
    changes: tuple[Change, ...] = ()


class DiskBench(Bench):
    """A bench whose trainings are runs in a folder; finished ones are read, unfinished ones go on.

    Args:
        teacher: the trained network.
        data: series to train on.
        experiment: settings of the teacher's run.
        source: where the recordings are.
        folder: for the runs.

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
    """Make smaller networks of a run, judge them in their formats, and choose the best that fits a budget.

    Choices rest on the validation part. The test part is opened once, for the chosen network and the teacher; that is
    recorded in the folder. For a run of a model search it is the second test set of the search, and the opening is
    recorded in its ledger, too. The same call goes on after a stop, and trains nothing twice.

    Args:
        run: run folder of the teacher.
        request: what is made of it.
        out: folder of the search, with a run for each network.
        source: recordings to learn, choose and judge on; by default those of the run.
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
    frozen = frozen_sessions(run, experiment)
    data = prepare_data(source or own, experiment, frozen)
    held_out = _held_out_test_of(source or own, experiment, data)
    # The judge changes no weights; its settings stay out of the key.
    settings = {key: value for key, value in plain_tree(experiment).items() if key != "judge"}
    key = run_key(settings | {"teacher": weights_digest(teacher)}, data.digest)
    with Run.create(out, "compression", key, experiment_toml(experiment)) as folder:
        bench = DiskBench(teacher, data, experiment, source or own, make_folder(folder.file("runs")))
        # A network judged in several formats is streamed in float only once.
        bench.frozen = frozen
        evaluator = _Evaluator(bench, spec.budget, Path(run), held_out.data)
        rows, notes = _rows(bench, evaluator, plan, spec, progress)
        front, chosen = choose(rows)
        result = CompressionResult(evaluator.teacher, rows, front, chosen, notes=[*plan.notes, *notes])
        if result.best is not None:
            result = replace(result, held_out_test=_judge_held_out(result, evaluator, folder, held_out, request.again))
        seen = held_out.seen(result.held_out_test.get("openings", ())) or _seen(Path(run), source, own, held_out)
        write_json(folder.file(RESULT), _plain(result, spec, data, seen, len(held_out.data.test)))
    return result


@dataclass(frozen=True, eq=False)
class _HeldOutTest:
    """The recordings that are looked at once.

    Attributes:
        data: they are its test part.
        name: of the sealed test set.
        study: folder of the model search that set it apart and records openings; None where none did, or it is gone.
        opened_before: whether a model search judged on it already.
    """

    data: Prepared
    name: str = TEST_PART
    study: Path | None = None
    opened_before: bool = False

    def seen(self, openings: Sequence[Mapping[str, Any]]) -> bool:
        """Whether other networks were judged on it before these."""
        return self.opened_before or len(openings) > 1


def _held_out_test_of(source: DataSource, experiment: Experiment, data: Prepared) -> _HeldOutTest:
    """The second test set of the model search that a run comes from, else the test part."""
    split = experiment.split
    if not isinstance(split, ByFrozen):
        return _HeldOutTest(data)
    # Sessions count by content: a renamed file is still the same recording.
    there = {recording.digest for recording in source.read()}
    if not any(session.digest in there for session in split.second):
        return _HeldOutTest(data, opened_before=any(session.digest in there for session in split.test))
    study = Path(split.study)
    recorded = split.study and is_file_at(study / "study.json") and is_file_at(study / "ledger" / "about.json")
    opened = prepare_data(source, replace(experiment, split=split.opened()))
    return _HeldOutTest(opened, SECOND_TEST_SET, study if recorded else None)


def _rows(
    bench: DiskBench, evaluator: _Evaluator, plan: CompressionPlan, spec: CompressionSearchSpec, progress: Progress
) -> tuple[list[Judged], list[str]]:
    """Every network in every format that it can be in, and what could not be."""
    names = _variants(bench) if spec.thesis else []
    bench.networks = progress.stage("network", plan.trainings + len(names))
    rows, notes = [], []

    def judge(order: CompressionRequest | None, network: Predictor, formats: Sequence[str]) -> None:
        for name in formats:
            try:
                rows.append(evaluator.judged(order, network, name))
            except ExportError as error:
                notes.append(f"{'teacher' if order is None else order.name} in {FORMATS[name].label}: {error}")

    judge(None, bench.teacher, plan.formats)
    for orders in plan.orders.values():
        networks = {order: bench.network(order) for order in orders}
        for order, network in networks.items():
            judge(order, network, plan.formats)
        # The better recipe is chosen in float: rounding is tried on one of them only, since it costs a training.
        plain = {order: evaluator.float_error(network) for order, network in networks.items()}
        for order in plan.tuned(min(plain, key=plain.__getitem__)):
            judge(order, bench.network(order), [name for name in plan.formats if FORMATS[name].rounded])
    for name in names:
        make = VARIANTS[name]
        rows.append(evaluator.variant(make(bench)))
    return rows, notes


def _variants(bench: Bench) -> list[str]:
    """Variants whose students are narrower than the teacher."""
    full = width_of(bench.teacher.spec)
    return [name for name, units in THESIS_VARIANTS.items() if units < full]


class _Evaluator:
    """Judges networks on the validation part, and at the end two on the test set: the test part of `held_out`."""

    def __init__(self, bench: DiskBench, budget: Budget, run: Path, held_out: Prepared) -> None:
        self.bench, self.budget, self.held_out = bench, budget, held_out
        self.data, self.skip = on_validation(bench.data), bench.teacher.spec.window
        self.deployed: dict[str, tuple[Deployed, Predictor]] = {}
        self._float: dict[int, dict[str, dict[str, float]]] = {}
        self.run = run
        plain = self._row("teacher", None, bench.teacher, "float32")
        self.teacher = replace(plain, error=1.0)

    def judged(self, order: CompressionRequest | None, network: Predictor, number_format: str) -> Judged:
        """A network in a format."""
        name = f"{'teacher' if order is None else order.name} {FORMATS[number_format].label}"
        row = self._row(name, order, network, number_format)
        return replace(row, error=relative(row.scores, self.teacher.scores))

    def variant(self, candidate: CompressedCandidate) -> Judged:
        """A variant of the thesis under its name, with bytes counted as the thesis counts them."""
        row = self._row(
            candidate.name, candidate.order, candidate.network, candidate.number_format, candidate.parameter_bytes
        )
        return replace(row, error=relative(row.scores, self.teacher.scores))

    def float_error(self, network: Predictor) -> float:
        """Error in float32, over the teacher's."""
        return relative(self._plain(network), self.teacher.scores)

    def on_held_out_test(self, row: Judged) -> dict[str, dict[str, float]]:
        """Scores on the sealed test set."""
        return measure(self.deployed[row.name][0], self.held_out, self.skip)

    def key(self, row: Judged) -> str:
        """What is judged: weights and format."""
        return f"{weights_digest(self.deployed[row.name][1])} {row.number_format}"

    def _plain(self, network: Predictor) -> dict[str, dict[str, float]]:
        if id(network) not in self._float:
            deployed = deploy(network, "float32", self.bench.data.train, self.budget)
            self._float[id(network)] = measure(deployed, self.data, self.skip)
        return self._float[id(network)]

    def _row(
        self,
        name: str,
        order: CompressionRequest | None,
        network: Predictor,
        number_format: str,
        stored: int | None = None,
    ) -> Judged:
        deployed = deploy(network, number_format, self.bench.data.train, self.budget, stored)
        self.deployed[name] = deployed, network
        before = self._plain(network)
        scores = before if number_format == "float32" else measure(deployed, self.data, self.skip)
        run = self.run if order is None else self.bench.folder / order.name
        return deployed_row(name, order, deployed, (scores, before), self.budget, str(run))


def _judge_held_out(
    result: CompressionResult, evaluator: _Evaluator, folder: Run, held_out: _HeldOutTest, again: bool
) -> dict[str, Any]:
    """Judge teacher and chosen on the sealed test set, once; the opening is recorded before it is made."""
    pair = {"teacher": result.teacher, "chosen": result.best}
    # Weights and format are the key of an opening: the same pair may be judged again without a second look.
    keys = [evaluator.key(row) for row in pair.values() if row is not None]
    why = "the network chosen by edp compress, and its teacher"
    ledgers = [folder.file("ledger")] if held_out.study is None else [held_out.study / "ledger", folder.file("ledger")]
    openings: list[dict[str, Any]] = []
    for ledger_folder in ledgers:  # that of the search first: it knows of openings from other folders
        with Ledger(ledger_folder) as ledger:
            opening = ledger.open_test_set(held_out.name, keys, why, again)
            openings = openings or [asdict(one) for one in ledger.openings(held_out.name)]
    scores = {name: evaluator.on_held_out_test(row) for name, row in pair.items() if row is not None}
    error = relative(scores["chosen"], scores["teacher"])
    return {"name": held_out.name, "opened": opening.time, "openings": openings, "scores": scores, "error": error}


def _seen(run: Path, source: DataSource | None, own: DataSource, held_out: _HeldOutTest) -> bool:
    """Whether the sealed test set is the test part and was judged before, by ``edp evaluate``."""
    # The test part of the same data that `edp evaluate` has judged is no sealed set any more.
    same = held_out.name == TEST_PART and (source is None or source.to_plain() == own.to_plain())
    return same and is_file_at(run / "scores.json")


def _plain(
    result: CompressionResult, spec: CompressionSearchSpec, data: Prepared, seen: bool, sealed: int
) -> dict[str, Any]:
    units = sorted({KINDS[kind].report_unit for kind in data.target_kinds})
    return {
        "schema": 2,
        "budget": asdict(spec.budget),
        "task": {"horizons": list(data.task.horizons), "rate_hz": data.task.rate_hz},
        "unit": units[0] if len(units) == 1 else "mixed units",
        "recordings": {"train": len(data.train), "validation": len(data.validation), "test": sealed},
        "teacher": result.teacher.to_json(),
        "rows": [row.to_json() for row in result.rows],
        "front": result.front,
        "chosen": result.chosen,
        "held_out_test": dict(result.held_out_test) | {"seen_before": seen},
        "notes": list(result.notes),
    }
