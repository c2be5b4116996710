"""The portfolio: kinds of models, each with the settings that suit an amount of data and a budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from edp.registry import Registry
from edp.settings.tree import Table

LEAST_SPAN = 32
"""Ticks that changes reach back at least, as far as the data allow: at 100 Hz a third of a second."""
WINDOW = 10
"""Ticks until a stream counts as warm, and between neighbouring stretches of different parts beside the horizon.

Changes over longer spans say less and less about the present: ten ticks after a reset their error was no larger than
later on measured recordings. A longer gap would throw away what lies nearest to the test."""
STRETCH_SHARE = 8
"""The longest change is at most an eighth of the shortest stretch, so that most of its rows are full."""
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
TREES, LEAST_TREES, TREE_DEPTH = 200, 80, 6
"""Of each output: half of them on what a line leaves, half on the target itself. Fewer say too little."""
TREE_ROWS = (30_000, 15_000, 8_000, 4_000)
"""Rows that a tree is grown on: the most that leave time for `LEAST_TREES` trees."""
TREE_FOLDS = (5, 3, 2)
"""Parts that trees leave out in turn: as many as leave time for all trees, else the fewest, for each costs a growth of
them. What two parts lose against five on the same rows was not measured; the rows and trees they pay for were."""
TREE_RATE, MOST_TREE_RATE = 10.0, 0.2
"""The rate of boosting is the first over the rounds, at least scikit-learn's 0.1: fewer trees must each do more."""
TREE_SECONDS, TREE_CELLS_PER_S = 1.7e-3, 1.2e8
"""A tree takes this long plus its rows times columns over that rate: measured with scikit-learn, rounded up."""
BATCH = 256
FOLDS = 5
SHARE = {"perceptrons": 0.2, "trees": 0.4, "recurrent": 0.4}
LONG_SHARE = {"perceptrons": 0.25, "trees": 0.15, "recurrent": 0.6}
"""Of the budget, up to `LONG_ROWS` and above; linear models and kernel machines take seconds."""
LEAST_STEPS, USUAL_STEPS, MOST_STEPS = 300, 2500, 5000
"""Updates of a member: fewer learn nothing, more than `USUAL_STEPS` pay where rows are many."""
ROW_PASSES = 20
"""How often a row may be seen before further updates only fit its noise."""
LONG_ROWS = 100_000
"""Training ticks above which most of the budget goes to the recurrent network, which has a memory of its own; below,
its useful updates cost less than its share, and trees were the rival to beat (26 min of a small excavator)."""
RECURRENT_ROWS = 20_000
"""Training ticks below which a recurrent network lost to the committee on every measured set that was tried."""
RECURRENT_LANES, RECURRENT_CHUNK, RECURRENT_BURN_IN = 8, 128, 50
RECURRENT_TICK = 70_000
"""Weights that a tick of the recurrent network passes through."""


@dataclass(frozen=True)
class Amount:
    """What there is to learn from, and how long it may take.

    Attributes:
        rows: ticks of the training and validation parts.
        shortest: ticks of their shortest stretch.
        features: features of a tick.
        outputs: horizons times targets.
        horizon: the largest one, in ticks.
        minutes: processor time.
        seed: of all random choices.
        threads: CPU threads.
    """

    rows: int
    shortest: int
    features: int
    outputs: int
    horizon: int
    minutes: float
    seed: int = 0
    threads: int = 1

    @property
    def span(self) -> int:
        """Ticks that changes reach back: a power of two, at least twice the horizon where the data allow it."""
        least = max(LEAST_SPAN, 2 * self.horizon)
        span = 1
        while span < least and 2 * span <= max(1, self.shortest // STRETCH_SHARE):
            span *= 2
        return span

    def seconds(self, kind: str) -> float:
        """Processor time for a kind of learner."""
        return 60 * self.minutes * (LONG_SHARE if self.rows > LONG_ROWS else SHARE)[kind]

    @property
    def window(self) -> int:
        """W of every candidate, so that all of them are cut from the recordings in the same way."""
        return min(WINDOW, self.span + 1)


@dataclass(frozen=True)
class Candidate:
    """A kind of model.

    Attributes:
        label: how sentences call it.
        tables: gives the tables ``model`` and ``training``; None where it does not suit the data.
    """

    label: str
    tables: Callable[[Amount], Table | None]


CANDIDATES: Registry[Candidate] = Registry("candidate")
"""The simplest first: of models that are equally good the first one is kept."""


def spans_by_half(amount: Amount) -> list[int]:
    """1, 2, 3, 4, 6, 8, 12, ... up to the longest span."""
    powers = [2**power for power in range(amount.span.bit_length())]
    halves = {3 * lag // 2 for lag in powers if lag > 1 and 3 * lag // 2 <= amount.span}
    return sorted({*powers, *halves})


def _columns(amount: Amount) -> int:
    return amount.features * (1 + len(spans_by_half(amount)))


def _steps(amount: Amount, groups: int) -> int:
    """Updates of each perceptron that the budget allows and the rows are worth."""
    weights = MEMBERS * groups * (_columns(amount) * UNITS + UNITS * UNITS + UNITS * amount.outputs)
    affordable = amount.seconds("perceptrons") * OPERATIONS_PER_S / (PASSES * BATCH * weights)
    useful = max(USUAL_STEPS, ROW_PASSES * amount.rows // BATCH)
    return int(min(max(affordable, LEAST_STEPS), useful, MOST_STEPS))


@dataclass(frozen=True)
class TreePlan:
    """What the budget allows of trees.

    Attributes:
        trees: of each output; 0 where there is no time for enough of them.
        rows: that each tree is grown on.
        folds: parts that they leave out.
    """

    trees: int
    rows: int
    folds: int

    @property
    def rate(self) -> float:
        """Of boosting; half of the trees are the rounds of either kind."""
        return min(MOST_TREE_RATE, max(0.1, TREE_RATE / max(1, self.trees // 2)))


def tree_plan(amount: Amount) -> TreePlan:
    """The most rows, then the most left-out parts, that leave time for the trees."""
    for rows in TREE_ROWS:
        seconds = TREE_SECONDS + min(rows, amount.rows) * _columns(amount) / TREE_CELLS_PER_S
        for folds in TREE_FOLDS:
            # Each part is left out by trees on the other rows; the network's trees are grown on all rows.
            trees = int(amount.seconds("trees") / (folds * amount.outputs * seconds))
            if trees >= (TREES if folds > TREE_FOLDS[-1] else LEAST_TREES):
                return TreePlan(min(trees, TREES), rows, folds)
    return TreePlan(0, TREE_ROWS[-1], TREE_FOLDS[-1])


def _linear(amount: Amount) -> Table:
    return _tables(amount, {"activations": []}, {})


def _committee(amount: Amount) -> Table:
    plan = tree_plan(amount)
    activations = ["tanh", "relu"]
    parts = {
        "activations": activations,
        "centres": min(CENTRES, amount.rows // ROWS_PER_CENTRE),
        "trees": plan.trees,
        "tree_depth": TREE_DEPTH,
    }
    trees = {"tree_rows": plan.rows, "tree_folds": plan.folds, "tree_rate": plan.rate}
    steps = _steps(amount, len(activations))
    return _tables(amount, parts, {"steps": steps, "robust_width": ROBUST, **trees})


def _tables(amount: Amount, parts: Table, bagging: Table) -> Table:
    backbone = {"kind": "committee", "lags": spans_by_half(amount), "members": MEMBERS, "units": UNITS, "layers": 2}
    return {
        "model": {
            "window": amount.window,
            "backbone": {**backbone, **parts},
            "head": {"kind": "linear"},
            "activation": {"kind": "identity"},
        },
        "training": {
            "loss": {"kind": "mse"},
            "seed": amount.seed,
            "threads": amount.threads,
            "bagging": {"folds": FOLDS, "batch": BATCH, **bagging},
        },
    }


CANDIDATES.register("linear")(Candidate("the linear model", _linear))
CANDIDATES.register("committee")(Candidate("the committee", _committee))


def _recurrent(amount: Amount) -> Table | None:
    """The network of the preset ``quick``, as many updates as the budget holds."""
    # Its trainer refuses validation stretches that end within burn-in and horizon.
    shortest = max(RECURRENT_CHUNK, RECURRENT_BURN_IN + amount.horizon + 1)
    if amount.rows < RECURRENT_ROWS or amount.shortest < shortest:
        return None
    epochs = 12
    tick = PASSES * RECURRENT_TICK * RECURRENT_LANES * RECURRENT_CHUNK
    affordable = amount.seconds("recurrent") * OPERATIONS_PER_S / (tick * epochs)
    useful = ROW_PASSES * amount.rows // (RECURRENT_LANES * RECURRENT_CHUNK * epochs)
    return {
        "model": {
            "window": amount.window,
            "backbone": {"kind": "hybrid", "channels": [64], "kernel": 5, "units": 64},
            "head": {"kind": "mlp", "hidden": 32, "layers": 1},
            "activation": {"kind": "identity"},
            "blocks": [{"kind": "temporal_difference"}],
        },
        "training": {
            "seed": amount.seed,
            "threads": amount.threads,
            "epochs": epochs,
            "updates": int(max(1, min(affordable, useful))),
            "patience": 0,
            "average": {"kind": "ema", "decay": 0.995},
            "chunks": {
                "regime": "chunk",
                "length": RECURRENT_CHUNK,
                "batch": RECURRENT_LANES,
                "burn_in": RECURRENT_BURN_IN,
            },
            "loss": {"kind": "huber", "delta": 0.3},
            "optimizer": {"kind": "soap", "learning_rate": 6e-3, "weight_decay": 1e-4},
            "schedule": {"kind": "one_cycle", "rise": 0.2},
        },
    }


CANDIDATES.register("recurrent")(Candidate("the recurrent network", _recurrent))
