"""Which twin suits these recordings: several formulations are fitted, and free runs of the validation part choose."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from edp.errors import ConfigError, DataError, NotFiniteError
from edp.evaluation.free_run import free_run_scores, free_runs
from edp.evaluation.guard import free_run_error
from edp.networks.twin import TWINS, Twin, TwinSpec
from edp.networks.twin.kinds import AutoTwin
from edp.networks.twin.recurrent import Recurrent
from edp.networks.twin.static_map import StaticTwin
from edp.report.twin.candidates import MOST_TEXT
from edp.storage.runs import KeyedRun, part_of
from edp.training.free_run import FittedTwin, FreeRunSpec, fit_free_runs
from edp.training.free_run_members import fit_members
from edp.workflows.twin.fit_twin import FittedFormulation, TwinFit

LENGTHS = (0.05, 0.15, 0.45, 1.0)
"""Shares of the updates of `[training]` that are tried in turn, each with a whole schedule of its learning rate.

A longer one is not always better: on 3 min of a cylinder under a hanging load 350 updates were better than 1,050."""
BOTH_FORMS = 2
"""Lengths at which a recurrent twin is trained with and without a static map; the better one goes on."""
LENGTHENED = 0.01
"""Share of error that a longer training must save, for the next length to be tried."""
LONG_TICKS = 100_000
"""Training ticks from which one wide network takes the place of three narrow ones, of the same width in all.

On 126,000 simulated ticks velocities had 0.60 and 0.63 of the static map's error; on 27,000 measured ones 0.97, the
average of three with less spread from seed to seed."""
MEMBERS = 3
AT = (0.1, 0.5, 1.0)
"""Shares of a free run after which strokes are compared."""


@dataclass(frozen=True, eq=False)
class TwinCandidate:
    """A formulation that was tried.

    Attributes:
        label: how sentences and tables call it.
        seconds: processor time.
        result: None where it could not be fitted.
        error: of its free runs in the validation part, over that of the static map; None where it could not be fitted.
        why: why it could not be fitted.
        chosen: whether it is kept.
    """

    label: str
    seconds: float
    result: FittedFormulation | None = None
    error: float | None = None
    why: str = ""
    chosen: bool = False

    def row(self) -> dict[str, Any]:
        """For ``free_run.json``."""
        plain = {"label": self.label, "error": self.error, "seconds": round(self.seconds, 2), "chosen": self.chosen}
        return plain | {"why": self.why[:MOST_TEXT]}


@dataclass(frozen=True, eq=False)
class _Trained:
    """A member of a recurrent twin after a training of some length."""

    error: float
    form: Recurrent
    training: FreeRunSpec
    fitted: FittedTwin

    @property
    def result(self) -> FittedFormulation:
        return FittedFormulation(self.form.alone(), self.fitted)

    @property
    def label(self) -> str:
        return labelled(self.form.alone(), self.training)


@dataclass(frozen=True, eq=False)
class TwinChoice:
    """A choice among formulations.

    Attributes:
        fit: what every fit needs.
        auto: the settings of the choice.
        run: folder and key; trainings that were stopped go on.
    """

    fit: TwinFit
    auto: AutoTwin
    run: KeyedRun

    def best(self) -> tuple[FittedFormulation, list[TwinCandidate]]:
        """The simplest of the candidates that are as good as the best, and all of them.

        Raises:
            ConfigError: none can be fitted to these recordings.
        """
        reference = self._scores(self._floor("static").start(*self._shared, self.fit.experiment.training.seed))
        tried = [one for name in self.auto.candidates for one in self._tried(name, reference)]
        fits = [(i, one.result, one.error) for i, one in enumerate(tried) if one.result and one.error is not None]
        if not fits:
            reasons = "; ".join(f"{one.label}: {one.why}" for one in tried)
            raise ConfigError(f"twin.candidates: none of them can be fitted to these recordings: {reasons}")
        enough = self._enough([error for _, _, error in fits])
        which, result, _ = next(entry for entry in fits if entry[2] <= enough)
        tried[which] = replace(tried[which], chosen=True)
        seconds = sum(one.seconds for one in tried)
        facts = result.facts | {"chosen": tried[which].label}
        return replace(result, fitted=replace(result.fitted, seconds=seconds), facts=facts), tried

    def _tried(self, name: str, reference: dict[str, Any]) -> list[TwinCandidate]:
        """A formulation with the default options; the recurrent one in several forms, the simplest first."""
        began = time.process_time()
        try:
            if name == "recurrent":
                return self._recurrent(reference)
            self.fit.tell(f"fitting {name}")
            with part_of(self.run, name) as own:
                result = self.fit.fitted(self._floor(name), own)
            error = self._error(result.fitted.twin, reference)
        except (ConfigError, DataError, NotFiniteError) as problem:
            # What does not suit these channels is no reason to give up on what does.
            return [TwinCandidate(name, time.process_time() - began, why=str(problem))]
        seconds = max(result.fitted.seconds, time.process_time() - began)
        return [TwinCandidate(described(result.spec), seconds, result, error)]

    def _recurrent(self, reference: dict[str, Any]) -> list[TwinCandidate]:
        """The recurrent twin on a static map or not, as long as longer training helps; last the average of members."""
        parts = (self.fit.data.train, self.fit.data.validation)
        wide = sum(part.samples for part in parts[0]) >= LONG_TICKS
        plain = Recurrent(prefix_ticks=self.auto.prefix_ticks, members=1 if wide else MEMBERS)
        forms = [replace(plain, valve_map=True), plain]
        statics = {form: form.static_map(*self._shared) for form in forms}
        trained: list[_Trained] = []
        diverged: list[TwinCandidate] = []
        for round_, share in enumerate(LENGTHS):
            before = min((one.error for one in trained), default=math.inf)
            training = shortened(self.fit.experiment.training, share)
            for form in forms if round_ < BOTH_FORMS or not trained else [self._simplest(trained).form]:
                try:
                    trained.append(self._member(form, statics[form], training, reference))
                except NotFiniteError as problem:
                    diverged.append(TwinCandidate(labelled(form.alone(), training), 0.0, why=str(problem)))
            if trained and min(one.error for one in trained) > before * (1.0 - LENGTHENED):
                break
        if not trained:
            return diverged
        first, form = self._simplest(trained), self._simplest(trained).form
        tried = [TwinCandidate(one.label, one.fitted.seconds, one.result, one.error) for one in trained] + diverged
        if form.members == 1:
            return tried
        self.fit.tell(f"training {form.members - 1} further members")
        shared = (self.fit.channels, self.fit.scales, statics[form])
        with part_of(self.run, _part_name(form, first.training)) as own:
            fitted = fit_members(form, shared, parts, first.training, self.fit.on_event, own, [first.fitted])
        error = self._error(fitted.twin, reference)
        if error < first.error:  # an average takes the place of its first member, however little better it is
            label = labelled(form, first.training)
            tried[trained.index(first)] = TwinCandidate(label, fitted.seconds, FittedFormulation(form, fitted), error)
        return tried

    def _simplest(self, trained: Sequence[_Trained]) -> _Trained:
        enough = self._enough([one.error for one in trained])
        return next(one for one in trained if one.error <= enough)

    def _enough(self, errors: Sequence[float]) -> float:
        """The error up to which a simpler candidate is as good as the best."""
        return min(errors) / (1.0 - self.auto.least_gain)

    def _member(
        self, form: Recurrent, static: StaticTwin | None, training: FreeRunSpec, reference: dict[str, Any]
    ) -> _Trained:
        """The first member of a form, trained for a length."""
        fit = self.fit
        fit.tell(f"training {labelled(form.alone(), training)}")
        twin = form.member(fit.channels, fit.scales, static, training.seed)
        with part_of(self.run, _part_name(form, training)) as own:
            fitted = fit_free_runs(twin, fit.data.train, fit.data.validation, training, fit.on_event, own)
        return _Trained(self._error(fitted.twin, reference), form, training, fitted)

    @property
    def _shared(self) -> tuple[Any, Any, Any]:
        return self.fit.channels, self.fit.scales, self.fit.data.train

    def _floor(self, name: str) -> TwinSpec:
        """The defaults of a formulation, with the prefix of all candidates."""
        spec: TwinSpec = replace(TWINS[name](), prefix_ticks=self.auto.prefix_ticks)
        return spec

    def _scores(self, twin: Twin) -> dict[str, Any]:
        """Of free runs as long as those that choose among weights.

        More of them fit into the validation part, and differ more from one another, than long ones.
        """
        experiment = self.fit.experiment
        seconds = experiment.training.validation_s
        at_s = tuple(sorted({share * seconds for share in AT}))
        judge = replace(experiment.judge, seconds=seconds, at_s=at_s)
        return free_run_scores(free_runs(twin, self.fit.data.validation, seconds, experiment.training.lanes), judge)

    def _error(self, twin: Twin, reference: dict[str, Any]) -> float:
        return free_run_error(self._scores(twin), reference)


def shortened(training: FreeRunSpec, share: float) -> FreeRunSpec:
    """The same training with a share of its updates in each stage, and as many validations."""
    updates = tuple(max(1, round(share * count)) for count in training.updates)
    return replace(training, updates=updates, validate_every=max(1, round(share * training.validate_every)))


def described(spec: TwinSpec) -> str:
    """How sentences call a formulation."""
    name = TWINS.name_of(spec)
    if not isinstance(spec, Recurrent):
        return name
    members = f"{spec.members} members, " if spec.members > 1 else ""
    return f"recurrent ({members}{spec.units} units{', on the static map' if spec.valve_map else ''})"


def labelled(form: Recurrent, training: FreeRunSpec) -> str:
    """How sentences call a recurrent twin that was trained so."""
    return f"{described(form)}, {sum(training.updates):,} updates"


def _part_name(form: Recurrent, training: FreeRunSpec) -> str:
    return f"recurrent{'_map' if form.valve_map else ''}_{sum(training.updates)}"
