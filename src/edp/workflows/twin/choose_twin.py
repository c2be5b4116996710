"""Choice of a twin's formulation: several are fitted, and their errors on left-out data decide."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from edp.data.series import Series
from edp.data.stretch_folds import StretchFold, stretch_folds
from edp.errors import ConfigError, DataError, NotFiniteError
from edp.evaluation.free_run import FreeRunJudgeSpec, FreeRuns, free_run_scores, free_runs
from edp.evaluation.free_run_file import MAX_TEXT, CandidateRow
from edp.evaluation.guard import free_run_error
from edp.networks.twin import TWINS, TwinSpec, fit_scales
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.model_selection import AutoTwin
from edp.networks.twin.recurrent import Recurrent, member_seed
from edp.storage.runs import PARTS, KeyedRun, part_of
from edp.training.free_run import FreeRunSpec
from edp.training.free_run_members import MemberTraining, join_members
from edp.wording import setting_text, typed
from edp.workflows.twin.fit_twin import FittedFormulation, TwinFit
from edp.workflows.twin.pace import paced
from edp.workflows.twin.training_cost import training_seconds

LENGTHS = (0.05, 0.15, 0.45, 1.0)
"""Shares of the updates of `[training]` that are tried in turn, each with a whole schedule of its learning rate.

A longer one is not always better: on 3 min of a cylinder under a hanging load 1,050 updates were better than 3,150."""
BOTH_FORMS = 2
"""Lengths at which a recurrent twin is trained with and without a static map; the better one goes on."""
LENGTHENED = 0.01
"""Share of error that a longer training must save, for the next length to be tried."""
LONG_TICKS = 100_000
"""Training ticks from which one wide network takes the place of the average of narrow ones, one for each fold.

On 126,000 simulated ticks velocities had 0.60 and 0.63 of the static map's error; on 27,000 measured ones 0.97, the
average of three with less spread from seed to seed."""
MEMBER_UNITS = 32
"""Width of a member's memory."""
RACED = 2
"""Folds after which a training that is far behind another is given up."""
FAR_BEHIND = 1.5
"""Times the error of the best training so far, in the same folds; less may be the folds' own difference."""
AT = (0.1, 0.5, 1.0)
"""Shares of a free run after which strokes are compared."""


@dataclass(frozen=True, eq=False)
class TwinTrial:
    """A formulation, fitted for each fold.

    Attributes:
        spec: its options.
        fits: a fit for each fold.
        runs: free runs of the segments that each fit left out.
    """

    spec: TwinSpec
    fits: tuple[FittedFormulation, ...]
    runs: tuple[FreeRuns, ...]


@dataclass(frozen=True, eq=False)
class TwinCandidate:
    """A formulation that was tried.

    Attributes:
        label: name in sentences and tables.
        seconds: processor time.
        trial: None where it could not be fitted, or was given up.
        error: free-run error on the data left out by each fit, relative to the static map; None without a trial.
        why: why there is no trial.
        chosen: whether it is kept.
    """

    label: str
    seconds: float
    trial: TwinTrial | None = None
    error: float | None = None
    why: str = ""
    chosen: bool = False

    @property
    def spec(self) -> TwinSpec | None:
        """Its options, where there is a trial."""
        return None if self.trial is None else self.trial.spec

    def row(self) -> CandidateRow:
        """Return the row for ``candidates.json``."""
        return CandidateRow(
            label=self.label,
            error=self.error,
            seconds=round(self.seconds, 2),
            chosen=self.chosen,
            why=self.why[:MAX_TEXT],
        )


@dataclass(frozen=True, eq=False)
class TwinChoice:
    """A choice among formulations.

    Attributes:
        fit: common inputs of all fits; training and validation part are divided again.
        auto: the settings of the choice.
        run: folder and key; trainings that were stopped go on.
    """

    fit: TwinFit
    auto: AutoTwin
    run: KeyedRun

    def best(self) -> tuple[FittedFormulation, list[TwinCandidate]]:
        """Return the simplest candidate within the tolerance of the best, and all candidates.

        Raises:
            ConfigError: no formulation can be fitted to these recordings.
        """
        tried: list[TwinCandidate] = []
        for name in self.auto.tried:
            tried += self._try_formulation(name, _best(tried))
        chosen = self._simplest(tried)
        if chosen is None or chosen.trial is None:
            reasons = "; ".join(f"{one.label}: {one.why}" for one in tried)
            raise ConfigError(f"twin.candidates: none of them can be fitted to these recordings: {reasons}")
        tried[tried.index(chosen)] = replace(chosen, chosen=True)
        result = self._fit_final(chosen.trial)
        # What chose is no less work than what was chosen.
        facts = {**result.fitted.facts, "chosen": chosen.label, "folds": len(self.folds)}
        fitted = replace(result.fitted, seconds=sum(one.seconds for one in tried), facts=facts)
        return replace(result, fitted=fitted), tried

    @cached_property
    def training(self) -> FreeRunSpec:
        """Return the training and comparison of candidates: the settings at the pace of slow and short logs."""
        block = sum(part.samples for part in self._everything) // self.auto.folds
        return paced(self.fit.experiment.training, self.fit.channels.rate_hz, block)

    @cached_property
    def folds(self) -> list[StretchFold]:
        """Return the division of training and validation part: by the settings, or each segment left out in turn.

        From `LONG_TICKS` on, and where a fold would be shorter than what is trained on, the settings' own division.
        """
        data, count, training = self.fit.data, self.auto.folds, self.training
        own = [StretchFold(data.train, data.validation)]
        if count == 1 or sum(part.samples for part in data.train) >= LONG_TICKS:
            return own
        prefix = self.auto.prefix_ticks
        least = prefix + round(max(training.lengths_s) * self.fit.channels.rate_hz) + 1
        try:
            divided = stretch_folds(self._everything, count, prefix, prefix + 2, training.seed)
        except DataError:
            return own
        sides = [side for fold in divided for side in (fold.train, fold.validation)]
        return divided if all(any(part.samples > least for part in side) for side in sides) else own

    @property
    def _everything(self) -> list[Series]:
        return [*self.fit.data.train, *self.fit.data.validation]

    @cached_property
    def _whole(self) -> TwinFit:
        """With all that may be learned from as training part: closed forms are fitted to it, maps and scales, too."""
        data = replace(self.fit.data, train=self._everything)
        return replace(self.fit, scales=fit_scales(self.fit.channels, self._everything), data=data)

    @cached_property
    def _reference(self) -> list[FreeRuns]:
        """Free runs of the static map in each fold."""
        spec, seed = self._default("static"), self.training.seed
        shared = (self._whole.channels, self._whole.scales)
        return [self._runs(spec.start(*shared, fold.train, seed), fold) for fold in self.folds]

    def _try_formulation(self, name: str, rival: TwinCandidate | None) -> list[TwinCandidate]:
        """Try a formulation with default options, or the recurrent formulation in several forms, the simplest first."""
        if name == "recurrent":  # a short training far behind a floor may be ahead of it as a long one
            return self._recurrent()
        spec = self._default(name)

        def fitted(some: range) -> Iterator[FittedFormulation]:
            for which in some:
                data = replace(self.fit.data, train=self.folds[which].train, validation=self.folds[which].validation)
                with part_of(self.run, self._part(name, which)) as own:
                    yield replace(self._whole, data=data).fitted(spec, own)

        self.fit.progress.note(f"fitting {name}")
        return [self._attempt(described(spec), spec, fitted, rival, FAR_BEHIND)]

    def _recurrent(self) -> list[TwinCandidate]:
        """Try the recurrent twin with and without a static map, and with longer trainings while the error decreases."""
        count = len(self.folds)
        plain = Recurrent(prefix_ticks=self.auto.prefix_ticks)
        if count > 1:
            plain = replace(plain, members=count, units=count * MEMBER_UNITS)
        forms = [replace(plain, valve_map=True), plain]
        tried: list[TwinCandidate] = []
        unfit: list[TwinCandidate] = []
        spent = 0.0
        for round_, share in enumerate(LENGTHS):
            before, count_before = _least(tried), len(tried)
            ahead = self._simplest(tried)
            for form in forms if round_ < BOTH_FORMS or ahead is None else [one for one in forms if one == ahead.spec]:
                training = shortened(self.training, share)
                cost = training_seconds(form, self.fit.channels, training, count)
                if self.auto.time_budget_min and spent + cost > 60.0 * self.auto.time_budget_min:
                    unfit.append(self._skip_training(form, training, spent + cost))
                    continue
                spent += cost
                # A length that helped neither form would take more time than all before it.
                most = FAR_BEHIND if round_ < BOTH_FORMS else 1.0
                tried.append(self._train_members(form, training, _best(tried), most))
            if len(tried) == count_before:
                break
            # Before the first training has ended there is nothing to be better than.
            if before * (1.0 - LENGTHENED) < _least(tried) < math.inf:
                break
        return tried + unfit[:1]

    def _skip_training(self, form: Recurrent, training: FreeRunSpec, seconds: float) -> TwinCandidate:
        """Return a training that is left out, with the reason."""
        why = (
            f"about {typed(seconds / 60.0, 2)} min of counted time with those before it, of time_budget_min = "
            f"{setting_text(self.auto.time_budget_min)}"
        )
        return TwinCandidate(labelled(form, training), 0.0, why=why)

    def _train_members(
        self, form: Recurrent, training: FreeRunSpec, rival: TwinCandidate | None, most: float
    ) -> TwinCandidate:
        """Train the members of a form for a length; each member leaves out a fold."""
        whole, label = self._whole, labelled(form, training)
        static = form.static_map(whole.channels, whole.scales, whole.data.train)
        name = f"recurrent{'_map' if form.valve_map else ''}_{sum(training.updates)}"

        def fitted(some: range) -> Iterator[FittedFormulation]:
            jobs = []
            for which in some:
                fold, seed = self.folds[which], member_seed(training.seed, which)
                # A map that knows what is left out would flatter the form that stands on it.
                own = static and static.refitted(fold.train)
                member = form.member(whole.channels, whole.scales, own, seed)
                folder = (self.run.folder.path / PARTS / self._part(name, which), self.run.key)
                seeded = replace(training, seed=seed)
                jobs.append(MemberTraining(label, member, fold.train, fold.validation, seeded, folder))
            for which, fit in zip(some, whole.train_members(jobs, whole.on_event), strict=True):
                self.fit.progress.note(f"trained {label}: fold {which + 1} of {len(self.folds)}")
                yield FittedFormulation(form.alone(), fit)

        self.fit.progress.note(f"training {label}")
        return self._attempt(label, form, fitted, rival, most)

    def _part(self, name: str, which: int) -> str:
        """Return the folder of a fold's fit in the run."""
        return f"{name}_fold_{which}" if len(self.folds) > 1 else name

    def _attempt(
        self,
        label: str,
        spec: TwinSpec,
        fitted: Callable[[range], Iterator[FittedFormulation]],
        rival: TwinCandidate | None,
        most: float,
    ) -> TwinCandidate:
        """Fit for each fold, up to where it has more than `most` times the error of a rival.

        Args:
            label: name in sentences.
            spec: its options.
            fitted: fits for some of the folds, in order.
            rival: the best one so far, None: there is none.
            most: see above.
        """
        began, count = time.process_time(), len(self.folds)
        fits: list[FittedFormulation] = []
        runs: list[FreeRuns] = []
        error, why = None, ""
        try:
            for some in (range(min(RACED, count)), range(RACED, count)):
                for which, fit in zip(some, fitted(some), strict=True):
                    fits.append(fit)
                    runs.append(self._runs(fit.fitted.twin, self.folds[which]))
                if rival is None or rival.trial is None or len(runs) == count:
                    continue
                if (behind := self._error(runs, rival.trial.runs)) > most:
                    there = f"{behind:.2f} times the error of {rival.label} there"
                    why = f"given up after {len(runs)} of {count} folds, with {there}"
                    break
            else:
                error = self._error(runs, self._reference)
        except (ConfigError, DataError, NotFiniteError) as problem:
            # What does not suit these channels is no reason to give up on what does.
            why = str(problem)
        # Helpers, and a training that was read from an earlier start, took time of their own.
        seconds = max(sum(fit.fitted.seconds for fit in fits), time.process_time() - began)
        trial = None if error is None else TwinTrial(spec, tuple(fits), tuple(runs))
        return TwinCandidate(label, seconds, trial, error, why)

    def _fit_final(self, trial: TwinTrial) -> FittedFormulation:
        """Return the twin of all training data; the intervals come from the left-out part of each fold."""
        first, several = trial.fits[0], len(trial.fits) > 1
        unseen = [(fit.fitted.twin, fold.validation) for fit, fold in zip(trial.fits, self.folds, strict=True)]
        if isinstance(trial.spec, Recurrent):
            result = FittedFormulation(trial.spec, join_members([fit.fitted for fit in trial.fits]))
        elif not first.fitted.history:
            result = self._whole.fitted(trial.spec, None)
        elif isinstance(trial.spec, ElementsBox):
            # Few numbers: free runs of all that may be learned from choose among the starting values as well.
            data = replace(self._whole.data, validation=self._everything)
            result = replace(self._whole, data=data).fitted(trial.spec, None)
        elif several:
            # Weights of several such fits have no mean; and each needs stretches that tell it when to stop.
            with part_of(self.run, TWINS.name_of(trial.spec)) as own:
                result = self.fit.fitted(trial.spec, own)
        else:
            result = first
        return replace(result, unseen=tuple(unseen))

    def _simplest(self, tried: Sequence[TwinCandidate]) -> TwinCandidate | None:
        """Return the simplest formulation that is as good as the best; of its trainings the best one."""
        enough = _least(tried) / (1.0 - self.auto.min_gain)
        spec = next((one.spec for one in tried if one.error is not None and one.error <= enough), None)
        return None if spec is None else _best([one for one in tried if one.spec == spec])

    def _default(self, name: str) -> TwinSpec:
        """Return a formulation with its defaults or the known elements, and the common prefix of the candidates."""
        elements = self.auto.elements if name == "elements" else None
        spec: TwinSpec = replace(elements or TWINS[name](), prefix_ticks=self.auto.prefix_ticks)
        return spec

    def _runs(self, twin: Any, fold: StretchFold) -> FreeRuns:
        """Return free runs on the left-out part of a fold, with the length of the validation runs.

        More of them fit into it, and differ more from one another, than long ones.
        """
        return free_runs(twin, fold.validation, self.training.validation_s, self.training.batch)

    def _error(self, runs: Sequence[FreeRuns], reference: Sequence[FreeRuns]) -> float:
        """Return the error relative to a reference in the same folds."""
        ours, theirs = (FreeRuns.joined(some) for some in (runs, reference[: len(runs)]))
        return relative_error(ours, theirs, self.fit.experiment.evaluation, self.training.validation_s)


def relative_error(runs: FreeRuns, reference: FreeRuns, judge: FreeRunJudgeSpec, seconds: float) -> float:
    """Return the error of free runs of a length in seconds, relative to a reference in the same runs."""
    judge = replace(judge, duration_s=seconds, at_s=tuple(sorted({share * seconds for share in AT})))
    return free_run_error(free_run_scores(runs, judge), free_run_scores(reference, judge))


def _least(tried: Sequence[TwinCandidate]) -> float:
    return min((one.error for one in tried if one.error is not None), default=math.inf)


def _best(tried: Sequence[TwinCandidate]) -> TwinCandidate | None:
    least = _least(tried)
    return next((one for one in tried if one.error == least), None)


def shortened(training: FreeRunSpec, share: float) -> FreeRunSpec:
    """Return the training with a fraction of its updates in each stage, and as many validations."""
    updates = tuple(max(1, round(share * count)) for count in training.updates)
    return replace(training, updates=updates, validate_every=max(1, round(share * training.validate_every)))


def described(spec: TwinSpec) -> str:
    """Return the name of a formulation in sentences."""
    name = TWINS.name_of(spec)
    if not isinstance(spec, Recurrent):
        return name
    members = f"{spec.members} x " if spec.members > 1 else ""
    return f"recurrent ({members}{spec.alone().units} units{', on the map' if spec.valve_map else ''})"


def labelled(form: Recurrent, training: FreeRunSpec) -> str:
    """Return the name of a recurrent twin with this training in sentences."""
    return f"{described(form)}, {sum(training.updates):,} updates"
