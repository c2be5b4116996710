"""Training of all candidates, choice by left-out data, and the winner as its own run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w

from edp.config.experiment import plain_tree
from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.jobs import IN_PROCESS, Workers
from edp.logs.source import DataSource
from edp.networks.predictor import build_model
from edp.progress import SILENT, Progress
from edp.report.run.choice import FLOOR, PERSISTENCE, AutoCandidate, AutoChoice, ErrorBounds, Skill, read_choice
from edp.settings.provenance import Provenance
from edp.storage.runs import FINISHED, Run, check_claimable, run_key, state_of
from edp.training import Bundle, load_bundle, make_bundle, save_bundle
from edp.training.blas import one_blas_thread
from edp.wording import percent
from edp.workflows.auto.candidates import CANDIDATES, Amount, linear_plan, read_foundation
from edp.workflows.auto.promise import (
    PortfolioChoice,
    Promise,
    blocks_of,
    by_output,
    choose,
    promise_of,
    standard_truth,
    to_report_units,
)
from edp.workflows.auto.recordings import (
    ReadOnce,
    check_moving,
    check_size,
    divide,
    fit_to_channels,
    prepare,
    still_inputs,
)
from edp.workflows.auto.settings import AutoSettings
from edp.workflows.auto.train_candidates import (
    TrainedCandidate,
    TrainedPortfolio,
    remove_trained_units,
    train_portfolio,
)
from edp.workflows.train_evaluate import keep_fitted


@dataclass(frozen=True, eq=False)
class AutoResult:
    """Result of an automatic training.

    Attributes:
        bundle: the winner's.
        choice: the content of ``auto.json``.
    """

    bundle: Bundle
    choice: AutoChoice

    @property
    def sentence(self) -> str:
        """State the choice and its reason."""
        return self.choice.sentence


@one_blas_thread()
def train_auto(
    source: DataSource,
    settings: AutoSettings,
    out: str | Path,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> AutoResult:
    """Train every candidate that suits the data, choose, and write the winner's run folder.

    Args:
        source: source of the recordings.
        settings: task, split, budget, evaluate.
        out: run folder; a finished one of the same settings and data is read, not made again.
        progress: receiver of the progress; its units are models.
        workers: who trains candidates; nodes see the run folder under the same path. The run has the same bits with any
            number.

    Raises:
        EdpError: the data, settings or folder cannot be used; what was on disk stays.
    """
    check_claimable(out, "auto")
    once = ReadOnce(source)
    foundation = read_foundation(settings.auto.foundation)
    if foundation is not None:
        foundation.check_recordings(once.read())
    settings, of_channels = fit_to_channels(settings, once.read()[0].channel_names, source.label)
    settings, of_parts = divide(once.read(), settings)
    data, amount = prepare(once, settings, foundation)
    if foundation is not None:
        foundation.check_task(data)
    begun = {} if foundation is None else {"foundation": foundation.facts}
    key = run_key({"auto": plain_tree(settings), **begun}, data.digest)
    finished = _read_finished(Path(out), key)
    if finished is not None:
        return finished
    check_moving(data)
    check_size(data)
    with Run.create(out, "auto", key, tomli_w.dumps(plain_tree(settings))) as run:
        portfolio = train_portfolio(settings, data, amount, run.path, workers, progress)
        notes = [*of_channels, *of_parts, *still_inputs(data)]
        result = _write_choice(run, source, portfolio, data, settings, notes)
        remove_trained_units(run.path)
        return result


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
    stated = replace(
        _make_choice_file(choice, trained, failed, data, settings, amount),
        key=run.key,
        notes=(*notes, *portfolio.notes),
    )
    winner, floor = trained[choice.name], trained.get(FLOOR)
    stated.write(run.path)
    if floor is not None and winner is not floor:
        # What the skill is measured against: `edp evaluate` needs its error on the test recordings, too.
        provenance = Provenance().add_entries(auto=stated.sentence)
        save_bundle(make_bundle(floor.fitted.predictor, data, provenance), run.file(FLOOR))
    bundle = keep_fitted(run, source, winner.experiment, data, winner.fitted, {"auto": stated.sentence})
    return AutoResult(bundle, stated)


def _read_finished(folder: Path, key: str) -> AutoResult | None:
    """Return the result of a finished run with this key; None without one."""
    # The key stands in the choice, too: earlier versions wrote the winner's key into the identity of the run.
    choice = read_choice(folder)
    if choice is None or choice.key != key or state_of(folder) != FINISHED:
        return None
    return AutoResult(load_bundle(folder), choice)


def _make_choice_file(
    choice: PortfolioChoice,
    trained: dict[str, TrainedCandidate],
    failed: dict[str, str],
    data: Prepared,
    settings: AutoSettings,
    amount: Amount,
) -> AutoChoice:
    """Return the content of ``auto.json`` without its key.

    Args:
        choice: chosen candidate.
        trained: all that were trained, by name.
        failed: messages of those that diverged.
        data: prepared series.
        settings: settings of the run.
        amount: amount of data and time.
    """
    candidates = {
        name: AutoCandidate(
            label=CANDIDATES[name].label,
            seconds=round(one.fitted.seconds, 2),
            parameters=sum(parameter.numel() for parameter in one.fitted.predictor.parameters()),
            promise=to_report_units(one.promise.error(), data),
        )
        for name, one in trained.items()
    }
    promise, floor = trained[choice.name].promise, trained.get(FLOOR)
    still = _persistence(data, amount)
    unchanged = to_report_units(still.last(len(promise.rows)).error(), data)
    tested = sum(max(0, part.samples - data.task.max_horizon) for part in data.test)
    against = still if floor is None or choice.name == FLOOR else floor.promise
    skill = promise.relative_to(against)
    return AutoChoice(
        minutes=settings.auto.time_budget_min,
        rows=amount.rows,
        chosen=choice.name,
        best=choice.best,
        excess=dict(choice.excess),
        doubt=dict(choice.doubt),
        sentence=_sentence(choice, trained, amount, data),
        candidates=candidates,
        persistence=unchanged,
        interval=ErrorBounds(
            **{side: to_report_units(bound, data) for side, bound in promise.interval(tested).items()}
        ),
        skill=Skill(
            against=PERSISTENCE if against is still else FLOOR,
            promise=by_output(skill.error(), data),
            interval=ErrorBounds(**{side: by_output(bound, data) for side, bound in skill.interval(tested).items()}),
        ),
        failed=failed,
        key="",
    )


def _persistence(data: Prepared, amount: Amount) -> Promise:
    """Return the errors of the present value, or of the mean in absolute mode."""
    # Any network with the scaling of the data: the kept one may have that of other machines.
    net = build_model(data.task, linear_plan(amount).model, data.scaler(), 0)
    truth = standard_truth(net, data)  # zero is no change, or in absolute mode the mean
    blocks, _ = blocks_of(data, amount.window)
    return promise_of([np.zeros_like(one) for one in truth], truth, blocks)


def _sentence(choice: PortfolioChoice, trained: dict[str, TrainedCandidate], amount: Amount, data: Prepared) -> str:
    """Return the choice and its reason in a sentence."""
    label = CANDIDATES[choice.name].label
    minutes = amount.rows / data.task.rate_hz / 60
    start = f"Of {len(trained)} models on {minutes:.1f} min of recordings, {label} is kept"
    others = [name for name in trained if name != choice.name]
    if not others:
        return f"{start}: no other one was tried, or all others diverged."
    if choice.name != choice.best:
        gain = percent(-float(np.expm1(-choice.excess[choice.name])))
        best = CANDIDATES[choice.best].label
        return (
            f"{start}: {best} had {gain} less error on left-out data, but that is within one standard error, and "
            "the simpler model wins a tie."
        )
    second = min(others, key=lambda name: choice.excess[name])
    gain = percent(-float(np.expm1(-choice.excess[second])))
    return f"{start}: on left-out data its error is {gain} less than that of the next best, {CANDIDATES[second].label}."
