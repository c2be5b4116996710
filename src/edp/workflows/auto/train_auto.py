"""Train the portfolio, choose by left-out data, and write the winner as a run of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from edp.config.experiment import plain_tree
from edp.data.prepared import Prepared
from edp.data.scaling import least_spread
from edp.data.task import TargetMode
from edp.errors import ConfigError, DataError
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.recording import FloatArray, Recording
from edp.report.run.choice import FILE, FLOOR, read_choice
from edp.signals import Kind
from edp.storage import write_json
from edp.storage.runs import FINISHED, Run, check_claimable, run_key, state_of
from edp.training import Bundle, load_bundle, make_bundle, save_bundle
from edp.training.blas import one_blas_thread
from edp.workflows.auto.candidates import LEAST_SPAN, Amount
from edp.workflows.auto.channels import MOST_LISTED, fit_to_channels
from edp.workflows.auto.choice_facts import choice_facts
from edp.workflows.auto.division import divide
from edp.workflows.auto.foundation import Foundation, read_foundation
from edp.workflows.auto.portfolio import TrainedPortfolio, Trainer, train_portfolio
from edp.workflows.auto.promise import choose
from edp.workflows.auto.settings import AutoSettings
from edp.workflows.auto.size import check_size
from edp.workflows.auto.train_candidates import TrainedCandidate
from edp.workflows.train_evaluate import keep_fitted, prepare_data

MOST_TICKS = 0.9
"""Share of the ticks whose stretches settle how far changes reach back: a short log among long ones shortens none."""


@dataclass(frozen=True, eq=False)
class AutoResult:
    """What an automatic training gives.

    Attributes:
        bundle: the winner's.
        facts: the content of ``auto.json``.
    """

    bundle: Bundle
    facts: dict[str, Any]

    @property
    def sentence(self) -> str:
        """What was chosen and why."""
        return str(self.facts["sentence"])


@one_blas_thread()
def train_auto(
    source: DataSource,
    settings: AutoSettings,
    out: str | Path,
    progress: Progress = SILENT,
    workers: int = 1,
) -> AutoResult:
    """Train every candidate that suits the data, choose, and write the winner's run folder.

    Args:
        source: where the recordings are.
        settings: task, split, budget, judge.
        out: run folder; a finished one of the same settings and data is read, not made again.
        progress: receiver of the progress; its units are models.
        workers: processes that train candidates side by side; 0 for one a core. The run has the same bits with any
            number.

    Raises:
        EdpError: the data, settings or folder cannot be used; what was on disk stays.
    """
    check_claimable(out, "auto")
    once = _ReadOnce(source)
    foundation = read_foundation(settings.auto.foundation)
    if foundation is not None:
        foundation.check_recordings(once.read())
    settings, of_channels = fit_to_channels(settings, once.read()[0].channel_names, source.label)
    settings, of_parts = divide(once.read(), settings)
    data, amount = _prepare(once, settings, foundation)
    if foundation is not None:
        foundation.check_task(data)
    key = _key(settings, data, foundation)
    finished = _finished(Path(out), key)
    if finished is not None:
        return finished
    _check_moving(data)
    check_size(data)
    with Run.create(out, "auto", key, tomli_w.dumps(plain_tree(settings))) as run:
        portfolio = train_portfolio(settings, data, amount, run.path, Trainer(workers, progress))
        return _write_choice(run, source, portfolio, data, settings, [*of_channels, *of_parts, *_still_inputs(data)])


def _write_choice(
    run: Run,
    source: DataSource,
    portfolio: TrainedPortfolio,
    data: Prepared,
    settings: AutoSettings,
    notes: Sequence[str],
) -> AutoResult:
    """Choose among the trained candidates and write the winner into the run.

    Raises:
        ConfigError: every candidate diverged.
    """
    outcomes, amount = portfolio.outcomes, portfolio.amount
    trained = {name: one for name, one in outcomes.items() if isinstance(one, TrainedCandidate)}
    failed = {name: one for name, one in outcomes.items() if isinstance(one, str)}
    if not trained:
        raise ConfigError(f"automatic choice: every candidate diverged: {'; '.join(failed.values())}")
    choice = choose({name: one.promise for name, one in trained.items()})
    facts = choice_facts(choice, trained, failed, data, settings, amount) | {
        "key": run.key,
        "notes": [*notes, *portfolio.notes],
    }
    winner, floor = trained[choice.name], trained.get(FLOOR)
    write_json(run.file(FILE), facts)
    if floor is not None and winner is not floor:
        # What the skill is measured against: `edp evaluate` needs its error on the test recordings, too.
        save_bundle(make_bundle(floor.fitted.predictor, data, {"auto": facts["sentence"]}), run.file(FLOOR))
    bundle = keep_fitted(run, source, winner.experiment, data, winner.fitted, {"auto": facts["sentence"]})
    return AutoResult(bundle, facts)


def _key(settings: AutoSettings, data: Prepared, foundation: Foundation | None) -> str:
    """Of the run: everything that decides its result."""
    begun = {} if foundation is None else {"foundation": foundation.facts}
    return run_key({"auto": plain_tree(settings), **begun}, data.digest)


def _finished(folder: Path, key: str) -> AutoResult | None:
    """Return the result of a finished run with this key; None if there is none."""
    # The key stands in the choice, too: earlier versions wrote the winner's key into the identity of the run.
    facts = read_choice(folder)
    if facts is None or facts["key"] != key or state_of(folder) != FINISHED:
        return None
    return AutoResult(load_bundle(folder), dict(facts))


class _ReadOnce:
    """A source whose recordings are read when they are first asked for."""

    def __init__(self, source: DataSource) -> None:
        self.path, self._source = source.path, source
        self._recordings: list[Recording] = []

    def read(self) -> list[Recording]:
        """The recordings."""
        self._recordings = self._recordings or self._source.read()
        return self._recordings

    def to_plain(self) -> dict[str, Any]:
        """As the source has it."""
        return self._source.to_plain()


def _prepare(source: _ReadOnce, settings: AutoSettings, foundation: Foundation | None) -> tuple[Prepared, Amount]:
    """The data cut for the candidates' common window, and what there is of it."""

    def cut(window: int) -> tuple[Prepared, Amount]:
        model = {"model": {"window": window, "backbone": {"kind": "committee"}, "head": {"kind": "linear"}}}
        data = prepare_data(source, settings.experiment(model))
        reach = data.task.max_horizon
        # A stretch that ends within the horizon holds nothing to predict; the digest stays that of all recordings.
        train, validation = (
            [part for part in stretches if part.samples > reach] for stretches in (data.train, data.validation)
        )
        if not train or not validation:
            raise DataError(
                f"automatic choice: no stretch of the training or of the validation part is longer than the largest "
                f"horizon of {reach} ticks; give longer recordings or a shorter horizon"
            )
        data = replace(data, train=train, validation=validation)
        parts = [*train, *validation]
        auto = settings.auto
        return data, Amount(
            rows=sum(part.samples for part in parts),
            shortest=min(part.samples for part in parts),
            usual=_usual([part.samples for part in parts]),
            features=len(data.task.features.features),
            outputs=len(data.task.horizons) * len(data.task.targets),
            horizon=data.task.max_horizon,
            minutes=auto.minutes,
            seed=auto.seed,
            threads=auto.threads,
            foundation=foundation,
            changes=data.task.mode is TargetMode.DELTA,
        )

    try:
        data, amount = cut(LEAST_SPAN + 1)
    except DataError:
        data, amount = cut(1)  # recordings of seconds: shorter spans will do
    if amount.window != LEAST_SPAN + 1:
        data, final = cut(amount.window)
        amount = replace(amount, rows=final.rows)
    return data, amount


def _usual(lengths: Sequence[int]) -> int:
    """The length that stretches with `MOST_TICKS` of all ticks have at least."""
    falling = np.sort(np.asarray(lengths))[::-1]
    return int(falling[np.searchsorted(falling.cumsum(), MOST_TICKS * falling.sum())])


def _check_moving(data: Prepared) -> None:
    """Refuse data that hold nothing to learn.

    Raises:
        DataError: a target or all inputs never move in the training part.
    """
    still = [
        name
        for name, moves in zip(
            data.task.targets, _moving([part.targets for part in data.train], data.target_kinds), strict=True
        )
        if not moves
    ]
    if still:
        raise DataError(
            f"the target {', '.join(still)} never moves in the training part; there is nothing to learn of it: take it "
            "out of task.targets, or record it while the machine works"
        )
    if not any(_moving([part.inputs for part in data.train], [channel.kind for channel in data.inputs])):
        raise DataError(
            "no input moves in the training part; a model of these recordings could only repeat a constant: record "
            "while the machine works, or check the signal map"
        )


def _still_inputs(data: Prepared) -> list[str]:
    """Which inputs say nothing since they stand still, in a sentence where there are some."""
    moving = _moving([part.inputs for part in data.train], [channel.kind for channel in data.inputs])
    still = [channel.name for channel, moves in zip(data.inputs, moving, strict=True) if not moves]
    if not still:
        return []
    more = f" and {len(still) - MOST_LISTED} more" if len(still) > MOST_LISTED else ""
    return [f"Still through the training part, so without weight: {', '.join(still[:MOST_LISTED])}{more}."]


def _moving(parts: Sequence[FloatArray], kinds: Sequence[Kind]) -> list[bool]:
    """Whether each channel moves in stretches ``(time, channel)``, by its own size: units differ by factors of 1e12."""
    values = np.concatenate(parts).astype(np.float64)
    spreads, sizes = values.std(axis=0), np.abs(values).max(axis=0)
    return [spread > least_spread(kind, size) for spread, size, kind in zip(spreads, sizes, kinds, strict=True)]
