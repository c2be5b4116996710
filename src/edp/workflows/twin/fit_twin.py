"""Fit of a twin of one formulation to prepared recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from edp.config.twin import TwinExperiment
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.jobs import IN_PROCESS, Workers
from edp.networks.twin import Twin, TwinScales, TwinSpec
from edp.networks.twin.elements import ElementsTwin
from edp.networks.twin.greybox import GreyTwin
from edp.networks.twin.recurrent import Recurrent
from edp.networks.twin.residual import Residual, ResidualTwin
from edp.progress import SILENT, Progress
from edp.storage.runs import KeyedRun
from edp.training.elements_fit import fit_elements
from edp.training.fitted_twin import FittedTwin, FreeRunProgress
from edp.training.free_run_members import MemberTraining, fit_members, member_unit, one_by_one, read_progress_notes
from edp.training.grey_fit import fit_grey_box
from edp.training.progress_steps import free_run_steps
from edp.training.residual_fit import fit_residual


@dataclass(frozen=True, eq=False)
class FittedFormulation:
    """A fitted twin.

    Attributes:
        spec: the formulation with the options that were settled.
        fitted: twin, history, processor time.
        unseen: twins beside segments that trained none of their weights; they calibrate the intervals. Empty where
            these are the twin itself and the validation part.
    """

    spec: TwinSpec
    fitted: FittedTwin
    unseen: tuple[tuple[Twin, Sequence[Series]], ...] = ()


@dataclass(frozen=True, eq=False)
class TwinFit:
    """Common inputs of all fits of a run.

    Attributes:
        channels: channels of the twin.
        scales: fitted to the training part.
        data: prepared series.
        experiment: the settings.
        progress: receiver of what begins; the units of a training are updates.
        workers: who trains members of an average.
    """

    channels: TwinChannels
    scales: TwinScales
    data: Prepared
    experiment: TwinExperiment
    progress: Progress = SILENT
    workers: Workers = IN_PROCESS

    @property
    def on_event(self) -> Callable[[FreeRunProgress], None]:
        """Listener of the trainings."""
        return free_run_steps(self.progress)

    def fitted(self, spec: TwinSpec, run: KeyedRun | None) -> FittedFormulation:
        """Return one formulation, fitted.

        Raises:
            EdpError: it does not suit the channels, or its fit ends in no numbers.
        """
        seed, parts = self.experiment.training.seed, (self.data.train, self.data.validation)
        if isinstance(spec, Recurrent):
            self.progress.note("training on free runs")
            static = spec.static_map(self.channels, self.scales, self.data.train)
            shared = (self.channels, self.scales, static)
            training = self.experiment.training
            fitted = fit_members(spec, shared, parts, training, self.on_event, run, self.train_members)
            return FittedFormulation(spec, fitted)
        started = time.process_time()
        twin = spec.start(self.channels, self.scales, self.data.train, seed)
        if isinstance(twin, ElementsTwin):
            self.progress.note("fitting the elements to free runs")
            return FittedFormulation(spec, fit_elements(twin, *parts, seed, self.on_event))
        if not isinstance(twin, GreyTwin):
            return FittedFormulation(spec, FittedTwin(twin, [], time.process_time() - started))
        self.progress.note("fitting the grey box to free runs")
        grey = fit_grey_box(twin, *parts, seed, self.on_event)
        # With as many stretches as were chosen: a bundle says how many numbers it has.
        settled = grey.twin.spec
        if not (isinstance(grey.twin, ResidualTwin) and isinstance(spec, Residual)):
            return FittedFormulation(settled, grey)
        self.progress.note("training the network on top of the grey box")
        network = fit_residual(grey.twin, spec, *parts, self.experiment.training, self.on_event, run)
        if not network.helps:
            self.progress.note("the network does not help on the validation part: the grey box stays alone")
        history, seconds = grey.history + network.history, grey.seconds + network.seconds
        return FittedFormulation(settled, FittedTwin(network.twin, history, seconds, grey.datasheet, network.facts))

    def train_members(
        self, jobs: Sequence[MemberTraining], on_event: Callable[[FreeRunProgress], None] | None
    ) -> Iterable[FittedTwin]:
        """Train networks in sequence or in parallel, and return them in order.

        Raises:
            EdpError: see `fit_free_runs`, or a process was killed again and again.
        """
        if self.workers.are_alone or any(job.folder is None for job in jobs):
            return one_by_one(jobs, on_event)
        shown: list[int] = []

        def look() -> None:
            event = read_progress_notes(jobs)
            if on_event is not None and event is not None and event.update not in shown:
                shown[:] = [event.update]
                on_event(event)

        for _ in self.workers.map([member_unit(job) for job in jobs], waiting=look):
            look()
        # What is trained is read from the folders.
        return one_by_one(jobs, None)

    def refitted(self, first: FittedFormulation) -> FittedFormulation:
        """Fit formulations without weight selection again, with the validation part included.

        The first fit, of the training part alone, calibrates the intervals.
        """
        data = replace(self.data, train=[*self.data.train, *self.data.validation])
        again = replace(self, data=data).fitted(first.spec, None)
        return replace(again, unseen=((first.fitted.twin, self.data.validation),))
