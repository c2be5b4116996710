"""Further training of a twin on other recordings, such as minutes of another machine's logs (fine-tuning)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edp.config.twin import TwinExperiment
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels, TwinChannelSettings
from edp.errors import ConfigError, DataError
from edp.evaluation.free_run import free_runs
from edp.networks.twin import TWINS, Twin
from edp.networks.twin.model_selection import AutoTwin
from edp.networks.twin.recurrent import RecurrentTwin, member_seed
from edp.networks.twin.recurrent_members import replace_scales, scales_for, separated
from edp.networks.twin.static_map import StaticMap
from edp.storage.runs import PARTS, KeyedRun
from edp.training.fitted_twin import FittedTwin
from edp.training.free_run_members import MemberTraining, join_members
from edp.training.twin_bundle import TwinBundle, load_twin, twin_hash
from edp.wording import typed
from edp.workflows.twin.choose_twin import LENGTHENED, TwinCandidate, relative_error, shortened
from edp.workflows.twin.fit_twin import FittedFormulation, TwinFit

SHARES = (0.05, 0.15, 0.45)
"""Shares of the updates of `[training]` that are tried in turn: minutes of logs hold less than the hours before."""
UNLIKE = 30.0
"""Times by which the largest value of a part may differ between machines: 10 and 50 t differ by less, units by more."""


@dataclass(frozen=True, eq=False)
class BaseTwin:
    """Trained twin as a start.

    Attributes:
        folder: folder of its run.
        bundle: the twin.
        digest: hash of its header, which holds those of its numbers.
    """

    folder: Path
    bundle: TwinBundle
    digest: str

    @staticmethod
    def from_run(folder: str | Path) -> BaseTwin:
        """Return the twin of a run folder.

        Raises:
            EdpError: not a twin, or one that no training can go on with.
        """
        base = BaseTwin(Path(folder), load_twin(folder), twin_hash(folder))
        _ = base.twin
        return base

    @property
    def twin(self) -> RecurrentTwin:
        """The twin.

        Raises:
            ConfigError: it is one that no training can go on with.
        """
        twin = self.bundle.twin
        if not isinstance(twin, RecurrentTwin):
            kind = TWINS.name_of(self.bundle.spec)
            raise ConfigError(
                f"--start {self.folder}: the twin is of kind '{kind}', which has no training that could go on; begin "
                "with a recurrent one, or fit this kind to the recordings anew, without --start"
            )
        return twin

    def settled(self, experiment: TwinExperiment) -> TwinExperiment:
        """Return settings with the formulation and the channels of this twin.

        Raises:
            ConfigError: they name others.
        """
        channels = self.bundle.twin.channels
        parts = ("commands", "velocities", "strokes", "pressures")
        names = TwinChannelSettings(**{part: tuple(c.name for c in getattr(channels, part)) for part in parts})
        if experiment.twin not in (AutoTwin(), self.bundle.spec):
            raise ConfigError(
                f"[twin] with --start {self.folder}: the formulation is that of the twin there; leave out its settings"
            )
        if experiment.channels not in (TwinChannelSettings(), names):
            raise ConfigError(
                f"[channels] with --start {self.folder}: the channels are those of the twin there; leave them out, or "
                "rename those of the recordings by a signal map"
            )
        return replace(experiment, twin=self.bundle.spec, channels=names)

    def check(self, channels: TwinChannels, train: Sequence[Series]) -> None:
        """Refuse recordings with another meaning of this twin's channels.

        Raises:
            DataError: another rate or kind of a channel, or values of another order of magnitude.
        """
        before = self.bundle.twin.channels
        if channels.rate_hz != before.rate_hz:
            raise DataError(
                f"the recordings have {typed(channels.rate_hz)} Hz, that of --start {self.folder} "
                f"{typed(before.rate_hz)} Hz; "
                "its memory counts ticks: record at that rate, or train a twin anew"
            )
        for ours, theirs in zip((*channels.commands, *channels.answers), (*before.commands, *before.answers)):
            if ours.kind is not theirs.kind:
                raise DataError(
                    f"'{ours.name}' is of kind {ours.kind} in the recordings, {theirs.kind} in the twin of --start "
                    f"{self.folder}; correct the signal map"
                )
        self._check_sizes(channels, train)

    def _check_sizes(self, channels: TwinChannels, train: Sequence[Series]) -> None:
        """Refuse values of another order of magnitude."""
        scales = self.bundle.twin.scales
        commands = np.max([np.abs(series.inputs).max(axis=0) for series in train], axis=0)
        answers = np.max([np.abs(series.targets).max(axis=0) for series in train], axis=0)
        largest = np.maximum(np.abs(scales.low), np.abs(scales.high))
        usual = np.abs(scales.command_offset) + 2.0 * scales.command_width
        parts = {"commands": (commands, usual)}
        parts |= {part: (answers[columns], largest[columns]) for part, columns in channels.parts.items()}
        for part, (now, before) in parts.items():
            # The largest of a part: a lever that nobody touched is no other unit.
            ratio = float(now.max() / before.max()) if len(now) and before.max() > 0.0 else 1.0
            if not 1.0 / UNLIKE < ratio < UNLIKE:
                name = getattr(channels, part)[int(np.argmax(now))].name
                raise DataError(
                    f"{part} of the recordings (largest: '{name}') are {typed(ratio, 3)} times those that the twin of "
                    f"--start {self.folder} knows; {typed(1.0 / UNLIKE, 2)} to {typed(UNLIKE)} must hold: check "
                    "units and "
                    "scales in the signal map"
                )

    def provenance(self) -> dict[str, object]:
        """Return the entries about this twin in the provenance of the new one."""
        data = self.bundle.provenance.origin.digest
        return {"from": {"run": str(self.folder), "hash": self.digest, "data": data}}


@dataclass(frozen=True, eq=False)
class ContinuedTwin:
    """Twin under fine-tuning; free runs of the validation part select the number of updates, possibly zero.

    Attributes:
        fit: common inputs of all fits of the run.
        start: the twin to begin with.
        run: folder and key; trainings that were stopped go on.
    """

    fit: TwinFit
    start: BaseTwin
    run: KeyedRun

    def best(self) -> tuple[FittedFormulation, list[TwinCandidate]]:
        """Return the best of the unchanged twin and the fine-tuned twins, and all candidates."""
        start = self.start.twin
        scales = scales_for(start, self.fit.scales, self.fit.data.train)
        # End stops are the machine's: the twin as it is has those of these recordings, too.
        as_it_is = replace_scales(start, scales)
        fits = [FittedTwin(as_it_is, [], 0.0)]
        tried = [TwinCandidate("the twin as it is", 0.0, error=self._error(as_it_is))]
        for share in SHARES:
            fit = self._train_members(as_it_is, share)
            label = f"{round(share * sum(self.fit.experiment.training.updates)):,} further updates"
            fits.append(fit)
            tried.append(TwinCandidate(label, fit.seconds, error=self._error(fit.twin)))
            before, now = tried[-2].error, tried[-1].error
            if before is None or now is None or now > (1.0 - LENGTHENED) * before:
                break
        best = min(range(len(tried)), key=lambda i: tried[i].error or math.inf)
        tried[best] = replace(tried[best], chosen=True)
        seconds, facts = sum(one.seconds for one in tried), self.start.provenance()
        return FittedFormulation(self.start.bundle.spec, replace(fits[best], seconds=seconds, facts=facts)), tried

    def _train_members(self, start: RecurrentTwin, share: float) -> FittedTwin:
        """Fine-tune each member from its start, and average the members again."""
        training = shortened(self.fit.experiment.training, share)
        train, validation = self.fit.data.train, self.fit.data.validation
        label = f"{sum(training.updates):,} further updates"
        self.fit.progress.note(label)
        jobs = []
        for which, member in enumerate(separated(start)):
            own = member.static and member.static.refitted(train)
            twin = RecurrentTwin(member.channels, member.scales, member.prefix_ticks, member.network, own)
            seeded = replace(training, seed=member_seed(training.seed, which))
            folder = self.run.folder.path / PARTS / f"further_{sum(training.updates)}_{which}"
            jobs.append(MemberTraining(label, twin, train, validation, seeded, (folder, self.run.key), True))
        fits = list(self.fit.train_members(jobs, self.fit.on_event))
        joined = join_members(fits)
        # One network of members that read one another stays the average that it was said to be.
        return joined if len(fits) > 1 else replace(joined, twin=_set_members(joined.twin, start.members))

    def _error(self, twin: Twin) -> float:
        """Return the error of free runs of the validation part over the static map's there."""
        training, data = self.fit.experiment.training, self.fit.data
        static = StaticMap(prefix_ticks=twin.prefix_ticks).start(twin.channels, twin.scales, data.train, 0)
        ours, theirs = (
            free_runs(one, data.validation, training.validation_s, training.batch) for one in (twin, static)
        )
        return relative_error(ours, theirs, self.fit.experiment.evaluation, training.validation_s)


def _set_members(twin: Twin, members: int) -> Twin:
    if not isinstance(twin, RecurrentTwin) or twin.members == members:
        return twin
    parts = (twin.channels, twin.scales, twin.prefix_ticks, twin.network, twin.static)
    return RecurrentTwin(*parts, members)
