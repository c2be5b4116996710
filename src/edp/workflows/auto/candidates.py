"""The portfolio: kinds of models, each with the settings that suit an amount of data and a budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from edp.data.chunks import ChunkSpec
from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.networks.activations import Identity
from edp.networks.backbones import CommitteeSpec, HybridSpec
from edp.networks.blocks import TemporalDifference
from edp.networks.heads import LinearHead, MlpHead
from edp.networks.losses import Huber, MeanSquared
from edp.networks.predictor import ModelSpec
from edp.recording import Recording
from edp.registry import Registry
from edp.training.averages import Exponential
from edp.training.bagging.radial import JUDGED_ROWS, LENGTHS
from edp.training.bagging.spec import BaggingSpec
from edp.training.bundle import weights_digest
from edp.training.optimizers import Soap
from edp.training.schedules import OneCycle
from edp.training.spec import TrainingSpec
from edp.training.strategy import TrainingStrategy
from edp.training.transfer.centring import Centred
from edp.training.transfer.checks import check_channels, check_lengths, check_signs, check_units
from edp.training.transfer.spec import FinetuneSpec
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import tuned
from edp.workflows.transfer.source import SourceModel, read_source

MIN_SPAN = 32
"""Ticks that changes reach back at least, as far as the data allow: at 100 Hz a third of a second."""
MAX_COLUMNS = 720
"""Columns of a bank at most, as far as its spans can be fewer: 48 channels have all spans, 100 only powers of two. A
ridge regression takes the square of them for each row, and its spectra the cube."""
WINDOW = 10
"""Ticks until a stream counts as warm, and between neighbouring segments of different parts beside the horizon.

Changes over longer spans say less and less about the present: ten ticks after a reset their error was no larger than
later on measured recordings. A longer gap would throw away what lies nearest to the test."""
STRETCH_SHARE = 8
"""The longest change is at most an eighth of the usual segment, so that most of its rows are full."""
OPERATIONS_PER_S = 1.6e10
"""Floating-point operations that training is taken to do in a second of one core: measured, rounded down.

Sizes follow from this constant and not from a clock: the same settings give the same network on every machine.
"""
PASSES = 6
"""Operations of a training step for each weight and row: two forward, four backward."""
MEMBERS, UNITS = 10, 64
ROBUST = 0.1
"""Threshold of the Huber loss of every second member: a tenth of the spread is close to the absolute error, by which
left-out rows choose where outliers rule."""
CENTRES, ROWS_PER_CENTRE = 300, 2
"""Twice as many centres were at most 2 % better on six of seven measured sets, and 6 % on the seventh (EMPS)."""
NEAR, NEAR_ROWS = (0, 1, 2, 4, 8), 20_000
"""Spans of the changes that further basis functions read beside the present values, 0 for these alone, and the ticks of
training up to which there are any. With weights that leave out one more fold, left-out errors of seven measured sets
change by 1 % (hanging load) to -16 % (tanks), -3 % on average; an output has them where theirs falls by 1 %."""
ROUNDS, MIN_ROUNDS, TREE_DEPTH = 100, 40, 6
"""Trees of each model of an output. Fewer say too little."""
TREE_MODELS = {3: 60, 2: MIN_ROUNDS}
"""Models of each output: of what a line leaves, of the target by few columns, of the target by all columns. The third
one is worth its time where it leaves so many rounds: left-out errors of five measured sets fall by 0.5 to 6 %."""
TREE_ROWS = (60_000, 30_000, 15_000, 8_000, 4_000)
"""Rows that a tree is grown on: the most that leave time for `MIN_ROUNDS`. On left-out logs of three measured sets
rows are worth more than rounds (journal)."""
TREE_FOLDS = {5: 0.8, 3: 0.6, 2: 0.4}
"""Parts that trees leave out in turn, each at the cost of a growth; and the share of rows beside the largest."""
ALIKE_ROWS = 0.8
"""Of the rows that the network's trees are grown on, left-out trees have so many. With two parts of 11,000 rows they
had half: left-out errors were up to three times those of the trees in use, which got too little weight."""
TREE_RATE, MAX_TREE_RATE = 10.0, 0.2
"""The rate of boosting is the first over the rounds, at least scikit-learn's 0.1: fewer trees must each do more."""
TREE_SECONDS, TREE_CELLS_PER_S = 1.7e-3, 1.2e8
"""A tree takes this long plus its rows times columns over that rate: measured with scikit-learn, rounded up."""
BATCH = 256
FOLDS = 5
SHARE = {"perceptrons": 0.2, "trees": 0.4, "recurrent": 0.4}
LONG_SHARE = {"perceptrons": 0.25, "trees": 0.15, "recurrent": 0.6}
"""Of what linear models and kernel machines leave of the budget, up to `LONG_ROWS` and above."""
ALONE = {"perceptrons": 0.2, "trees": 0.5, "recurrent": 0.0}
"""Of it where the recurrent network failed its trial. More would be ready later: nothing else runs beside trees."""
TRIAL = 0.08
"""Of it, and of the recurrent network's share, for a first short training of that network (see `RecurrentTrial`)."""
LINEAR_PRODUCTS_PER_S, LINEAR_MODELS = 2e10, 2
"""Products of columns that sums for a ridge regression take in a second, and how many candidates need them. Measured
were 2.8e10 to 7.4e10: every row is multiplied out once, whatever the folds."""
EIGEN_CUBES_PER_S = 1e9
"""Cubes of the number of columns in a second, of the spectra of a fold over all sets of columns; measured: 2e9."""
RADIAL_ROW_S, RADIAL_CELL_S = 3e-5, 3.7e-8
"""A row of radial basis functions of one length takes the first, and the second for each column: measured."""
MIN_SHARE = 0.5
"""Of the budget is left for networks and trees, however long the linear models take."""
MIN_STEPS, USUAL_STEPS, MAX_STEPS = 300, 2500, 5000
"""Updates of a member: fewer learn nothing, more than `USUAL_STEPS` pay where rows are many."""
ROW_PASSES = 20
"""How often a row may be seen before further updates only fit its noise."""
FEW_STEPS, MAX_PASSES = 500, 200
"""Rows of a short log are seen so often at most, but for so many updates: of 457 rows 2,500 updates leave 5 % more
error on left-out rows than 700, of 966 rows 1,500 leave 1 % more than 300 and take five times as long."""
LONG_ROWS = 100_000
"""Training ticks above which most of the budget goes to the recurrent network, if its trial says that it will do well;
below, its useful updates cost less than its share, and trees were the rival to beat (26 min of a small excavator)."""
RECURRENT_ROWS = 20_000
"""Training ticks below which a recurrent network lost to the committee on every measured set that was tried."""
RECURRENT_LANES, RECURRENT_CHUNK, RECURRENT_BURN_IN = 8, 128, 50
RECURRENT_TICK = 70_000
"""Weights that a tick of the recurrent network passes through."""
SETTING = "auto.foundation"
MIN_UPDATES = 120
"""Of a fine-tuning, where ten passes over the recordings are fewer: those of the measured ones (benchmarks/results)."""


@dataclass(frozen=True)
class NetworkPlan:
    """Settings of a network and of its training."""

    model: ModelSpec
    training: TrainingSpec


@dataclass(frozen=True, eq=False)
class Foundation:
    """A network to begin with, as ``auto.foundation`` names it.

    Attributes:
        path: path as stated in the settings.
        source: the network and the settings of its run.
    """

    path: str
    source: SourceModel

    @property
    def window(self) -> int:
        """W of the network, which every candidate then has: all are cut from the recordings in the same way."""
        return self.source.predictor.spec.window

    @property
    def facts(self) -> dict[str, str]:
        """Return its identity."""
        return {"weights": weights_digest(self.source.predictor)}

    @property
    def weights(self) -> int:
        """Count the parameters that a tick of training uses."""
        return sum(parameter.numel() for parameter in self.source.predictor.parameters())

    @property
    def ticks(self) -> int:
        """Return the number of samples of an update over the batch."""
        chunks = self._training(0, 1).chunks
        return chunks.length * chunks.batch

    def check_recordings(self, recordings: Sequence[Recording]) -> None:
        """Refuse recordings without the channels, or of another rate, than the network's.

        Raises:
            DataError: channels are missing or rates differ; the message names channels, recordings and advice.
        """
        check_channels(recordings, self.source.bundle.task)

    def check_task(self, data: Prepared) -> None:
        """Refuse a task other than the network's, and recordings on which it cannot be fine-tuned.

        Raises:
            ConfigError: every part of the task that differs.
            DataError: recordings that are too short, in other units or of another sign convention.
        """
        own, asked = self.source.bundle.task, data.task
        pairs = {
            "targets": (own.targets, asked.targets),
            "horizons": (own.horizons, asked.horizons),
            "mode": (own.mode, asked.mode),
            "features": (own.features.features, asked.features.features),
        }
        other = [f"{name} {its}, the settings {here}" for name, (its, here) in pairs.items() if its != here]
        if not other and own != asked:
            other = ["derived targets or hidden channels that the settings do not have"]
        if other:
            raise ConfigError(
                f"{SETTING}: the network of '{self.path}' has {'; '.join(other)}; these must be equal: change [task], "
                "pretrain with this task, or leave the setting out"
            )
        check_lengths(data, self._training(0, 1).chunks, self.window)
        check_units(data, self.source.predictor.front)
        check_signs(data, None)

    def plan(self, rows: int, affordable: float, seed: int, threads: int) -> NetworkPlan:
        """Return the network and the training of the candidate.

        Args:
            rows: ticks to train on.
            affordable: updates that the budget allows.
            seed: seed of all random choices.
            threads: CPU threads.
        """
        rounds = FinetuneSpec().single_phase_epochs
        updates = int(min(affordable, max(MIN_UPDATES, rounds * rows / self.ticks))) // rounds
        training = replace(self._training(max(1, updates), threads), seed=seed)
        return NetworkPlan(self.source.predictor.spec, training)

    def _training(self, updates: int, threads: int) -> TrainingSpec:
        """Return the training of `edp train finetune --method full` with this number of updates per epoch."""
        own = tuned(self.source.experiment.training, FinetuneSpec())
        return replace(own, updates=updates, threads=threads, ensemble=None)

    def strategy(self) -> TrainingStrategy:
        """Return the strategy: initial weights, and removal of the mean training error at the end."""
        return Centred(WarmStart(self.source.predictor))


def read_foundation(path: str) -> Foundation | None:
    """Read the network that the settings name; None if not set.

    Raises:
        ConfigError: a committee, whose parts do not learn by gradient.
        EdpError: no run or bundle in float32 is there.
    """
    if not path:
        return None
    foundation = Foundation(path, read_source(path, recordings=False))
    if isinstance(foundation.source.predictor.spec.backbone, CommitteeSpec):
        raise ConfigError(
            f"{SETTING}: '{path}' is a committee, which the preset makes of the recordings itself; give a network that "
            "was trained by gradient, such as a run of edp train pretrain, or leave the setting out"
        )
    return foundation


class RecurrentTrial(Enum):
    """Decision on the recurrent network by a short training: whether it is worth its part of the budget.

    On simulated machines it is far ahead of a committee, on each measured set that was tried far behind: there its time
    is worth more to the trees (39 min of a full-size excavator; decision 99).
    """

    NONE = "none"
    RUNNING = "running"
    PASSED = "passed"
    FAILED = "failed"


@dataclass(frozen=True)
class Amount:
    """Amount of training data and time budget.

    Attributes:
        rows: ticks of the training and validation parts.
        shortest: ticks of their shortest segment.
        usual: ticks of most of their segments; 0 for those of the shortest one.
        trial: result of the recurrent network's trial, which decides how the budget is divided.
        features: features of a tick.
        outputs: horizons times targets.
        horizon: the largest one, in ticks.
        minutes: processor time.
        seed: seed of all random choices.
        threads: CPU threads.
        foundation: a pretrained network to begin with; None for none.
        changes: whether changes are predicted, of which zero is none.
    """

    rows: int
    shortest: int
    features: int
    outputs: int
    horizon: int
    minutes: float
    seed: int = 0
    threads: int = 1
    foundation: Foundation | None = None
    changes: bool = True
    usual: int = 0
    trial: RecurrentTrial = RecurrentTrial.NONE

    @property
    def span(self) -> int:
        """Ticks that changes reach back: a power of two, at least twice the horizon where the data allow it."""
        least = max(MIN_SPAN, 2 * self.horizon)
        span = 1
        while span < least and 2 * span <= max(1, (self.usual or self.shortest) // STRETCH_SHARE):
            span *= 2
        return span

    def seconds(self, kind: str) -> float:
        """Return the processor time for a kind of learner."""
        budget = 60 * self.minutes
        left = max(budget - _estimate_fixed_seconds(self), MIN_SHARE * budget)
        shares = LONG_SHARE if self.rows > LONG_ROWS else SHARE
        match self.trial:
            case RecurrentTrial.RUNNING:
                shares = dict.fromkeys(shares, 0.0) | {"recurrent": TRIAL}
            case RecurrentTrial.PASSED:
                shares = shares | {"recurrent": shares["recurrent"] - TRIAL}
            case RecurrentTrial.FAILED:
                shares = ALONE
        return left * shares[kind]

    @property
    def window(self) -> int:
        """W of every candidate, so that all of them are cut from the recordings in the same way."""
        return min(WINDOW, self.span + 1) if self.foundation is None else self.foundation.window


@dataclass(frozen=True)
class Candidate:
    """A kind of model.

    Attributes:
        label: name in sentences.
        plan: returns the network and its training; None where it does not suit the data.
    """

    label: str
    plan: Callable[[Amount], NetworkPlan | None]


CANDIDATES: Registry[Candidate] = Registry("candidate")
"""The simplest first: of models that are equally good the first one is kept."""


@dataclass(frozen=True)
class Spans:
    """Time spans of a feature bank for each channel, apart from its present value.

    Attributes:
        lags: ticks over which a channel changes.
        smoothed: spans among them over which the mean of as many ticks changes, too.
    """

    lags: list[int]
    smoothed: list[int]

    def columns(self, features: int) -> int:
        """Return the number of columns of a bank with `features` features."""
        return features * (1 + len(self.lags) + len(self.smoothed))


def spans_of(amount: Amount) -> Spans:
    """Return 1, 2, 3, 4, 6, 8, 12, ... up to the longest span, and means over 4, 8, 16, .

    Fewer where channels are many.
    """
    powers = [2**power for power in range(amount.span.bit_length())]
    halves = {3 * lag // 2 for lag in powers if lag > 1 and 3 * lag // 2 <= amount.span}
    smoothed = powers[2:]
    tried = [Spans(sorted({*powers, *halves}), smoothed), Spans(powers, smoothed), Spans(powers, [])]
    sparse = Spans(powers[::2], [])
    return next((spans for spans in tried if spans.columns(amount.features) <= MAX_COLUMNS), sparse)


def _columns(amount: Amount) -> int:
    return spans_of(amount).columns(amount.features)


def _steps(amount: Amount, groups: int) -> int:
    """Return the number of updates of each perceptron within the budget and within the useful number."""
    weights = MEMBERS * groups * (_columns(amount) * UNITS + UNITS * UNITS + UNITS * amount.outputs)
    affordable = amount.seconds("perceptrons") * OPERATIONS_PER_S / (PASSES * BATCH * weights)
    useful = max(USUAL_STEPS, ROW_PASSES * amount.rows // BATCH)
    most = max(FEW_STEPS, MAX_PASSES * amount.rows // BATCH)
    return int(min(max(affordable, MIN_STEPS), useful, most, MAX_STEPS))


def _estimate_fixed_seconds(amount: Amount) -> float:
    """Return the processor time of parts that no budget shortens: linear models and radial basis functions."""
    rows, columns = min(amount.rows, BaggingSpec().max_rows), _columns(amount)
    linear = LINEAR_MODELS * (2 * rows * columns**2 / LINEAR_PRODUCTS_PER_S + FOLDS * columns**3 / EIGEN_CUBES_PER_S)
    kernels = len(LENGTHS) * min(rows, JUDGED_ROWS) + (rows if rows > JUDGED_ROWS else 0)
    near = sum(RADIAL_ROW_S + RADIAL_CELL_S * amount.features * (1 + (span > 0)) for span in _list_near_spans(amount))
    return linear + kernels * (RADIAL_ROW_S + RADIAL_CELL_S * columns + near)


def _list_near_spans(amount: Amount) -> list[int]:
    """Return the spans of the basis functions on few columns."""
    lags = spans_of(amount).lags
    return [span for span in NEAR if span == 0 or span in lags] if amount.rows <= NEAR_ROWS else []


@dataclass(frozen=True)
class TreePlan:
    """Sizes of the tree ensembles within the budget.

    Attributes:
        rounds: trees of each model; 0 where there is no time for enough of them.
        models: number of models of each output.
        rows: number of rows per tree.
        folds: parts that they leave out.
    """

    rounds: int
    models: int
    rows: int
    folds: int

    @property
    def trees(self) -> int:
        """Trees of each output."""
        return self.rounds * self.models

    @property
    def rate(self) -> float:
        """Learning rate of boosting."""
        return min(MAX_TREE_RATE, max(0.1, TREE_RATE / max(1, self.rounds)))


def tree_plan(amount: Amount) -> TreePlan:
    """Return the tree ensembles within the time: most rows first, then most models, then most left-out parts.

    Where rows are drawn from many, few parts leave left-out trees as many rows as those of the network have; else the
    fewest that do take fewer rounds. Parts too few for it come last: such trees are better than none.
    """
    sparse = Spans([lag for lag in spans_of(amount).lags if lag & (lag - 1) == 0], []).columns(amount.features)
    fewest = min(TREE_FOLDS)
    enough = {
        rows: [
            folds for folds, share in TREE_FOLDS.items() if share * amount.rows >= ALIKE_ROWS * min(rows, amount.rows)
        ]
        for rows in TREE_ROWS
    }
    for rows, parts in [*enough.items(), (TREE_ROWS[-1], [fewest])]:
        for models, least in TREE_MODELS.items():
            cells = min(rows, amount.rows) * (sparse + (models - 1) * _columns(amount))
            seconds = models * TREE_SECONDS + cells / TREE_CELLS_PER_S
            for folds in parts:
                # Each part is left out by trees on the other rows; the network's trees are grown on all rows.
                rounds = int(amount.seconds("trees") / (folds * amount.outputs * seconds))
                if rounds >= (ROUNDS if folds > parts[-1] else least):
                    return TreePlan(min(rounds, ROUNDS), models, rows, folds)
    return TreePlan(0, len(TREE_MODELS), TREE_ROWS[-1], fewest)


def linear_plan(amount: Amount) -> NetworkPlan:
    """Return the linear model, which suits every amount."""
    return _plan(amount, _bank(amount), BaggingSpec(folds=FOLDS, batch=BATCH))


def _committee(amount: Amount) -> NetworkPlan:
    plan, activations = tree_plan(amount), ("tanh", "relu")
    backbone = replace(
        _bank(amount),
        activations=activations,
        centres=min(CENTRES, amount.rows // ROWS_PER_CENTRE),
        local_lags=tuple(_list_near_spans(amount)),
        trees=plan.trees,
        tree_depth=TREE_DEPTH,
    )
    bagging = BaggingSpec(
        folds=FOLDS,
        batch=BATCH,
        steps=_steps(amount, len(activations)),
        huber_delta=ROBUST,
        tree_models=plan.models,
        tree_max_rows=plan.rows,
        tree_folds=plan.folds,
        tree_learning_rate=plan.rate,
    )
    return _plan(amount, backbone, bagging)


def _bank(amount: Amount) -> CommitteeSpec:
    """Return a committee of linear members on the feature bank of an amount."""
    spans = spans_of(amount)
    bank = CommitteeSpec(lags=tuple(spans.lags), smoothed=tuple(spans.smoothed), clip_inputs=True)
    return replace(bank, members=MEMBERS, units=UNITS, layers=2, activations=())


def _plan(amount: Amount, backbone: CommitteeSpec, bagging: BaggingSpec) -> NetworkPlan:
    head = LinearHead(dead_band=amount.changes)
    return NetworkPlan(
        ModelSpec(window=amount.window, backbone=backbone, head=head, activation=Identity()),
        TrainingSpec(loss=MeanSquared(), seed=amount.seed, threads=amount.threads, ensemble=bagging),
    )


CANDIDATES.register("linear")(Candidate("the linear model", linear_plan))
CANDIDATES.register("committee")(Candidate("the committee", _committee))


def _recurrent(amount: Amount) -> NetworkPlan | None:
    """Return the network of the preset ``quick`` with as many updates as the budget holds."""
    # Its trainer refuses validation stretches that end within burn-in and horizon.
    shortest = max(RECURRENT_CHUNK, RECURRENT_BURN_IN + amount.horizon + 1)
    if amount.rows < RECURRENT_ROWS or amount.shortest < shortest:
        return None
    epochs = 12
    tick = PASSES * RECURRENT_TICK * RECURRENT_LANES * RECURRENT_CHUNK
    trained = 1 if amount.foundation is None else 2
    affordable = amount.seconds("recurrent") / trained * OPERATIONS_PER_S / (tick * epochs)
    useful = ROW_PASSES * amount.rows // (RECURRENT_LANES * RECURRENT_CHUNK * epochs)
    model = ModelSpec(
        window=amount.window,
        backbone=HybridSpec(channels=(64,), kernel=5, units=64),
        head=MlpHead(hidden=32, layers=1),
        activation=Identity(),
        blocks=(TemporalDifference(),),
    )
    training = TrainingSpec(
        seed=amount.seed,
        threads=amount.threads,
        epochs=epochs,
        updates=int(max(1, min(affordable, useful))),
        patience=0,
        average=Exponential(decay=0.995),
        chunks=ChunkSpec(length=RECURRENT_CHUNK, batch=RECURRENT_LANES, burn_in=RECURRENT_BURN_IN),
        loss=Huber(delta=0.3),
        optimizer=Soap(learning_rate=6e-3, weight_decay=1e-4),
        schedule=OneCycle(warmup=0.2),
    )
    return NetworkPlan(model, training)


CANDIDATES.register("recurrent")(Candidate("the recurrent network", _recurrent))


def _foundation(amount: Amount) -> NetworkPlan | None:
    """Return a pretrained network whose weights are all trained."""
    start = amount.foundation
    if start is None:
        return None
    trained = 1 if _recurrent(amount) is None else 2
    seconds = amount.seconds("recurrent") / trained
    affordable = seconds * OPERATIONS_PER_S / (PASSES * start.weights * start.ticks)
    return start.plan(amount.rows, affordable, amount.seed, amount.threads)


CANDIDATES.register("foundation")(Candidate("the pretrained network", _foundation))
