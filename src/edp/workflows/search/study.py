"""Ask-and-tell interface to Optuna without storage; a continued search reports its values again.

A study is a pure function of its root seed and of the reports, in the order of the trials: each question is asked
with a sampler seeded by root and number. So a search that was killed asks the same again and finds the answers in the
ledger, and any number of workers gives the same sequence.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edp.errors import ConfigError
from edp.evaluation.study_facts import TrialRow
from edp.settings.bounds import MAX_NAMES, check_bounds, integer
from edp.storage import replacing
from edp.workflows.search.arms import Arm
from edp.workflows.search.space import Candidate, Choice, Range, Real, Space, check, names
from edp.workflows.search.trainings import Outcome, TrainingRequest

if TYPE_CHECKING:
    import optuna

GP_TRIALS = 100  # a Gaussian process is the better sampler up to here, then it gets slow
STARTUP = 10


@dataclass
class Trial:
    """A question of a study, from asking to its score.

    Attributes:
        number: index in the order of asking, from 0.
        values: values of the dimensions of the space.
        modules: switches that are on, such as modules; `options`: values of their options.
        arm: arm of the trial.
        costs: analytic costs of its network, by name; none if its values make no network.
        requests: whole trainings, one a run; none if it is not trained for its costs.
        outcomes: outcomes of the last part of each training.
        rungs: means over runs at steps before the end.
        pruned: whether it was ended at the last rung.
        score: mean over its runs; None if it was not trained, was pruned, or failed.
    """

    number: int
    values: Candidate
    modules: tuple[str, ...] = ()
    options: Candidate = field(default_factory=dict)
    arm: Arm = field(default_factory=Arm)
    costs: Mapping[str, float] = field(default_factory=dict)
    requests: list[TrainingRequest] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    rungs: dict[int, float] = field(default_factory=dict)
    pruned: bool = False
    score: float | None = None

    def mean(self, horizon: int, name: str = "composite") -> float | None:
        """Return a score, mean over its runs; None if missing, or one did not end well."""
        scores = [outcome.mean(horizon, name) for outcome in self.outcomes]
        return float(np.mean(scores)) if scores and np.isfinite(scores).all() else None

    def row(self, horizon: int) -> TrialRow:
        """Return its row in the study's file."""
        return TrialRow(
            number=self.number,
            values={**self.values, **self.options},
            score=self.score,
            mae=None if self.pruned else self.mean(horizon, "mae"),
            parameters=self.costs.get("parameters"),
            macs_tick=self.costs.get("macs_tick"),
            rungs=tuple(self.rungs.items()) or None,
            pruned=self.pruned if self.rungs else None,
        )


@dataclass(frozen=True, kw_only=True)
class SamplerSpec:
    """Settings of the sampler.

    Attributes:
        kind: ``gp`` (a Gaussian process for the first 100 trials, then TPE), ``tpe``, ``thesis_tpe`` (univariate,
            without liar, as in the thesis) or ``random``.
        startup: trials at random before the first model.

    Raises:
        ConfigError: an unknown kind, or fewer than one trial at random.
    """

    kind: str = "gp"
    startup: int = STARTUP

    def __post_init__(self) -> None:
        if self.kind not in SAMPLERS:
            raise ConfigError(f"sampler '{self.kind}'; {', '.join(SAMPLERS)} must hold")
        check_bounds("sampler", self, startup=integer(1, MAX_NAMES))


@dataclass
class Study:
    """Optuna study of a space; smaller values are better.

    Attributes:
        space: dimensions and their ranges.
        root: seed of the whole sequence.
        sampler: sampler of the trials.
        flags: switches that may be on or off.
        barred: sets of switches that cannot be on together: of each the later one in `flags` is switched off.
        objectives: number of reported values.
        pruner: ``none``, or ``median``, which says of a reported trial whether it is worse than the median of those
            that were reported before, at the same step; only with one objective.
        bounds: number of costs that must not exceed zero; a trial that exceeds may be reported by its costs alone,
            so that what cannot be used need not be trained. With bounds TPE stands in for the Gaussian process.
        options: further dimensions of a switch, asked where it is on.
    """

    space: Space
    root: int
    sampler: SamplerSpec = field(default_factory=SamplerSpec)
    flags: tuple[str, ...] = ()
    barred: frozenset[frozenset[str]] = frozenset()
    objectives: int = 1
    bounds: int = 0
    pruner: str = "none"
    options: Mapping[str, Mapping[str, Choice]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        import optuna

        both = sorted(set(self.flags) & set(self.space))
        if both:
            raise ConfigError(f"study: {', '.join(both)} would be a dimension and a switch; rename one of them")
        if self.pruner != "none" and self.objectives > 1:
            raise ConfigError(
                f"study: pruner '{self.pruner}' with {self.objectives} objectives; one of them, or no pruner, must hold"
            )
        logging.getLogger("optuna").setLevel(logging.ERROR)
        self._study = optuna.create_study(
            directions=["minimize"] * self.objectives,
            sampler=optuna.samplers.RandomSampler(seed=0),
            # Optuna's defaults: after five whole trials; the first rung is the warm-up.
            pruner=optuna.pruners.MedianPruner() if self.pruner == "median" else optuna.pruners.NopPruner(),
        )
        self._distributions = {name: _distribution(self.space[name]) for name in names(self.space)} | {
            name: _distribution(Choice((0, 1))) for name in self.flags
        }
        self._open: dict[int, optuna.Trial] = {}
        self._told = 0
        self._waiting: dict[int, tuple[Sequence[float] | None, Sequence[float], bool]] = {}

    def suggest(self, values: Candidate, flags: Sequence[str] | None = None, options: Candidate | None = None) -> None:
        """Ask this next as a warm start; the sampler chooses missing values.

        Args:
            values: values of some or all dimensions.
            flags: switches that are on, the others being off; None leaves them all to the sampler.
            options: options of active switches.

        Raises:
            ConfigError: a value outside the space, or an unknown dimension, switch or option.
        """
        unknown = [name for name in values if name not in self.space]
        if unknown:
            raise ConfigError(f"study: there is no dimension '{unknown[0]}' (it has {', '.join(self.space)})")
        check({name: self.space[name] for name in values}, values)
        strange = [name for name in flags or () if name not in self.flags]
        if strange:
            raise ConfigError(f"study: there is no switch '{strange[0]}' (it has {', '.join(self.flags)})")
        own: dict[str, Range] = {}
        for name in flags or ():
            own |= self.options.get(name, {})
        odd = [name for name in options or () if name not in own]
        if odd:
            raise ConfigError(f"study: there is no option '{odd[0]}' of what is on (there are {', '.join(own)})")
        check({name: own[name] for name in options or ()}, options or {})
        switched = {} if flags is None else {name: int(name in flags) for name in self.flags}
        self._study.enqueue_trial(dict(values) | switched | dict(options or {}))

    def ask(self, count: int) -> list[Trial]:
        """Return the next `count` questions; earlier ones count as unanswered until they are reported."""
        return [self._ask() for _ in range(count)]

    def _ask(self) -> Trial:
        number = len(self._study.trials)
        waiting = any(trial.state.name == "WAITING" for trial in self._study.trials)
        if waiting:
            number = next(trial.number for trial in self._study.trials if trial.state.name == "WAITING")
        # A sampler for each question, seeded by its number: questions do not depend on how often the search was
        # stopped.
        self._study.sampler = self._sampler(number)
        asked = self._study.ask(self._distributions)
        self._open[asked.number] = asked
        values = {name: asked.params[name] for name in names(self.space)}
        on = self._select_allowed(tuple(name for name in self.flags if asked.params[name]))
        chosen: dict[str, Any] = {
            name: asked.suggest_categorical(name, choice.options)
            for flag in on
            for name, choice in self.options.get(flag, {}).items()
        }
        return Trial(asked.number, values, on, chosen)

    def _select_allowed(self, on: tuple[str, ...]) -> tuple[str, ...]:
        allowed: tuple[str, ...] = ()
        for name in on:
            # Barred partners: the first of a pair in the registry's order stays on.
            if not any(name in pair and set(pair) <= {*allowed, name} for pair in self.barred):
                allowed = (*allowed, name)
        return allowed

    def report(self, number: int, step: int, value: float) -> None:
        """Report the value of an unanswered question at a step of its training.

        Raises:
            ConfigError: a question that was not asked, a value that is not finite, or several objectives.
        """
        if number not in self._open or number in self._waiting:
            raise ConfigError(f"study: trial {number} was not asked, or is finished; report before you tell")
        if self.objectives > 1 or not math.isfinite(value):
            raise ConfigError(
                f"study: trial {number} reports {value} at step {step} of a study with {self.objectives} objectives; a "
                "finite value and one objective must hold"
            )
        self._open[number].report(value, step)

    def hopeless(self, number: int) -> bool:
        """Return whether the pruner would end a question after its last report, by the reports of earlier ones."""
        return self.pruner != "none" and bool(self._open[number].should_prune())  # NumPy's would not be plain

    def tell(
        self, number: int, values: Sequence[float] | None, costs: Sequence[float] = (), pruned: bool = False
    ) -> None:
        """Report the values of a trial; trials enter the study in the order of their numbers.

        Args:
            number: number of the trial.
            values: values of the objectives; None if the training failed, diverged or was not run.
            costs: each at most 0 where its bound is kept.
            pruned: it was ended after its last report; it has no values.

        Raises:
            ConfigError: a question that was not asked, a value that is not finite, another count of them, or values of
                one that was pruned.
        """
        if number not in self._open and number not in self._waiting:
            raise ConfigError(f"study: trial {number} was not asked, or is finished; tell each once")
        if pruned and values is not None:
            raise ConfigError(
                f"study: trial {number} is reported as pruned, with values {list(values)}; none must hold"
            )
        for what, expected_count, numbers in (("values", self.objectives, values), ("costs", self.bounds, costs)):
            if numbers is not None and (len(numbers) != expected_count or not all(map(math.isfinite, numbers))):
                raise ConfigError(
                    f"study: trial {number} is reported {what} {list(numbers)}; {expected_count} finite ones must hold"
                )
        self._waiting[number] = (values, costs, pruned)
        # In the order of numbers, whatever the order in which trainings end.
        while self._told in self._waiting:
            self._pass_on(self._told, *self._waiting.pop(self._told))
            self._told += 1

    def _pass_on(self, number: int, values: Sequence[float] | None, costs: Sequence[float], pruned: bool) -> None:
        from optuna.trial import TrialState

        trial = self._open.pop(number)
        for index, cost in enumerate(costs):
            trial.set_constraint(f"bound {index}", cost)
        if values is None:  # Never as infinity: a sampler would model the wall.
            # Beyond a bound is pruned, not failed: the sampler learns the constraint.
            beyond = pruned or any(cost > 0 for cost in costs)
            self._study.tell(trial, state=TrialState.PRUNED if beyond else TrialState.FAIL)
        else:
            self._study.tell(trial, list(values))

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        seed = int.from_bytes(hashlib.blake2b(f"{self.root} {number}".encode(), digest_size=4).digest(), "big")
        kind, startup = self.sampler.kind, self.sampler.startup
        # A Gaussian process does not learn from trials that were refused for their costs.
        if kind == "gp" and (number >= GP_TRIALS or self.bounds):
            kind = "tpe"
        from optuna.samplers import GPSampler, RandomSampler, TPESampler

        if kind == "random":
            return RandomSampler(seed=seed)
        if kind == "thesis_tpe":
            return TPESampler(seed=seed, n_startup_trials=startup, multivariate=False, constant_liar=False)
        if kind == "tpe":
            return TPESampler(seed=seed, n_startup_trials=startup, multivariate=True)
        return GPSampler(
            seed=seed,
            n_startup_trials=startup,
            independent_sampler=TPESampler(seed=seed, n_startup_trials=startup),
            warn_independent_sampling=False,
        )


SAMPLERS = ("gp", "tpe", "thesis_tpe", "random")
PRUNERS = ("none", "median")


def _distribution(dimension: Range) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(dimension, Real):
        return FloatDistribution(dimension.low, dimension.high, log=dimension.log)
    if dimension.options == (0, 1):
        return IntDistribution(0, 1)
    return CategoricalDistribution(dimension.options)


@dataclass(frozen=True)
class FinishedStudy:
    """A study that is over, for a viewer.

    Attributes:
        name: name of the study.
        space: dimensions and their ranges.
        modules: switches.
        trials: trials in the order of asking.
        objectives: names of what was made small: the score, and a cost if there are two.
    """

    name: str
    space: Space
    modules: Sequence[str]
    trials: Sequence[TrialRow]
    objectives: tuple[str, ...]


def write_journal(path: str | Path, studies: Sequence[FinishedStudy]) -> None:
    """Write studies as a journal that Optuna and its dashboard read; a file there is replaced whole.

    Raises:
        StorageError: it cannot be written.
    """
    import optuna
    from optuna.storages.journal import JournalFileBackend

    logging.getLogger("optuna").setLevel(logging.ERROR)
    # Replaced whole: a dashboard that reads meanwhile sees the old file or the new one.
    with replacing(path) as temporary:
        storage = optuna.storages.JournalStorage(JournalFileBackend(str(temporary)))
        for finished in studies:
            directions: list[Any] = ["minimize"] * len(finished.objectives)
            study = optuna.create_study(storage=storage, study_name=finished.name, directions=directions)
            # A viewer shows objectives without units; the names carry them.
            study.set_user_attr("objectives", list(finished.objectives))
            study.add_trials([_freeze_trial(finished, trial) for trial in finished.trials])


def _freeze_trial(study: FinishedStudy, trial: TrialRow) -> optuna.trial.FrozenTrial:
    from optuna.trial import TrialState, create_trial

    # Options of modules that were off are absent, switches are always there.
    values = {**trial.values, **{module: int(module in (trial.modules or ())) for module in study.modules}}
    space = {**study.space, **dict.fromkeys(study.modules, Choice((0, 1)))}
    answer = None if trial.score is None else [trial.score, *(trial.costs[name] for name in study.objectives[1:])]
    state = TrialState.FAIL if answer is None else TrialState.COMPLETE
    # Pruned trials keep their reports, which the viewer draws as curves.
    reports = dict(trial.rungs or ())
    if trial.pruned:  # Optuna, too, gives it the last value that it reported
        answer, state = [reports[max(reports)]], TrialState.PRUNED
    return create_trial(
        state=state,
        values=answer,
        params=values,
        distributions={name: _distribution(space[name]) for name in values},
        user_attrs={"mae": trial.mae, **trial.costs},
        intermediate_values=reports,
    )
