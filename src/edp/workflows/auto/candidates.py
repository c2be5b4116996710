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
MEMBERS, UNITS, GROUPS = 10, 64, 2
BATCH = 256
SHARE = {"committee": 0.2, "long_committee": 0.2, "recurrent": 0.6}
"""Of the budget, by candidate; a linear model takes seconds."""
LEAST_STEPS, USUAL_STEPS, MOST_STEPS = 300, 2500, 5000
"""Updates of a member: fewer learn nothing, more than `USUAL_STEPS` pay where rows are many."""
ROW_PASSES = 20
"""How often a row may be seen before further updates only fit its noise."""
LONG_ROWS = 100_000
"""Training ticks above which the budget goes to the recurrent network, which has a memory of its own."""
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


def spans_by_two(amount: Amount) -> list[int]:
    """1, 2, 4, ... up to the longest span."""
    return [2**power for power in range(amount.span.bit_length())]


def spans_by_half(amount: Amount) -> list[int]:
    """1, 2, 3, 4, 6, 8, 12, ... up to the longest span."""
    halves = {3 * lag // 2 for lag in spans_by_two(amount) if lag > 1 and 3 * lag // 2 <= amount.span}
    return sorted({*spans_by_two(amount), *halves})


def _committee(amount: Amount, lags: list[int], activations: list[str], share: float, loss: Table) -> Table:
    columns = amount.features * (1 + len(lags))
    weights = MEMBERS * max(1, len(activations)) * (columns * UNITS + UNITS * UNITS + UNITS * amount.outputs)
    affordable = 60 * amount.minutes * share * OPERATIONS_PER_S / (PASSES * BATCH * weights)
    useful = max(USUAL_STEPS, ROW_PASSES * amount.rows // BATCH)
    steps = int(min(max(affordable, LEAST_STEPS), useful, MOST_STEPS))
    return {
        "model": {
            "window": amount.window,
            "backbone": {
                "kind": "committee",
                "lags": lags,
                "members": MEMBERS,
                "units": UNITS,
                "layers": 2,
                "activations": activations,
            },
            "head": {"kind": "linear"},
            "activation": {"kind": "identity"},
        },
        "training": {
            "loss": loss,
            "seed": amount.seed,
            "threads": amount.threads,
            "bagging": {"folds": 5, "steps": steps, "batch": BATCH},
        },
    }


CANDIDATES.register("linear")(
    Candidate("the linear model", lambda amount: _committee(amount, spans_by_half(amount), [], 0.0, {"kind": "mse"}))
)
CANDIDATES.register("committee")(
    Candidate(
        "the committee",
        lambda amount: _committee(amount, spans_by_two(amount), ["tanh", "relu"], SHARE["committee"], {"kind": "mse"}),
    )
)
CANDIDATES.register("long_committee")(
    Candidate(
        "the committee on more spans",
        lambda amount: (
            None
            if amount.rows > LONG_ROWS
            else _committee(amount, spans_by_half(amount), ["tanh", "relu"], SHARE["long_committee"], {"kind": "mse"})
        ),
    )
)


def _recurrent(amount: Amount) -> Table | None:
    """The network of the preset ``quick``, as many updates as the budget holds."""
    # Its trainer refuses validation stretches that end within burn-in and horizon.
    shortest = max(RECURRENT_CHUNK, RECURRENT_BURN_IN + amount.horizon + 1)
    if amount.rows < RECURRENT_ROWS or amount.shortest < shortest:
        return None
    epochs = 12
    tick = PASSES * RECURRENT_TICK * RECURRENT_LANES * RECURRENT_CHUNK
    affordable = 60 * amount.minutes * SHARE["recurrent"] * OPERATIONS_PER_S / (tick * epochs)
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
