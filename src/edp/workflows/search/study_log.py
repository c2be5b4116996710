"""Progress of a study as plain values in ``study.json``, for its report and for `edp search status`."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from edp.errors import StorageError
from edp.evaluation.study import FILE, Decision, PhaseRow, StudyFile, TrainingCounts, TrainingRow, read_study
from edp.progress import Progress
from edp.storage import find_holder, write_json
from edp.storage.ledger import Opening, Record, digest_of
from edp.storage.paths import entries_of
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.modules import MODULES, title_of
from edp.workflows.search.phases import PHASES
from edp.workflows.search.trainings import Outcome, TrainingRequest

# Two seconds: a viewer does not follow faster, and a record a second would cost more than it tells.
EVERY_S = 2.0


class StudyLog:
    """Record of events in the study's file, at most every two seconds except for decisions and the end.

    Rows of trainings stand in the order in which they were asked for, whatever order they ended in, so that a search
    that was stopped and went on writes what one that was not would have written, times apart. A training
    that is done in parts is one row; one whose next part is not asked for with the others of its batch was pruned.

    Args:
        folder: folder of the study.
        study: constant entries: mode, preset, data, spec, sessions.
        context: context of the search, before any decision.

    Attributes:
        trained: trainings of this sitting.
        openings: openings of the sealed test sets.
        state: ``running``, ``stopped`` or ``finished``.
        workers: trainings that run side by side.
    """

    def __init__(self, folder: Path, study: StudyFile, context: SearchContext) -> None:
        self.file = folder / FILE
        self.horizon = context.spec.horizon
        self.decisions: list[Decision] = []
        self.phases: dict[str, PhaseRow] = {}
        self.rows: dict[str, TrainingRow] = {}
        self.openings: list[Opening] = []
        self.trained = 0
        self.workers = 1
        self._row_of: dict[str, str] = {}
        self._paused: dict[str, None] = {}
        self._now: set[str] = set()
        self._heard: set[str] = set()
        self._expected = {name: phase.trainings(context) for name, phase in PHASES.items()}
        self._seconds = 0.0
        self._phase_began = 0.0
        self._written = 0.0
        # The log is for viewers; the ledger holds all that counts: a log that cannot be read is written anew.
        earlier = None
        with contextlib.suppress(StorageError):
            earlier = read_study(self.file)
        self._before = {} if earlier is None else {phase.name: phase for phase in earlier.phases}
        self.study = replace(study, created=_now() if earlier is None else earlier.created)
        self.state = "running"

    def on_phase(self, name: str, context: SearchContext) -> None:
        """Note the start of a phase."""
        self._phase_began = time.monotonic()
        began = self._before[name].began if name in self._before else _now()
        self.phases[name] = PhaseRow(name=name, title=PHASES[name].title, began=began)
        for later in list(PHASES)[list(PHASES).index(name) :]:
            self._expected[later] = PHASES[later].trainings(context)
        self.write(force=True)

    def on_batch(self, batch: Mapping[str, TrainingRequest]) -> None:
        """Note a requested batch of trainings by key; repeated requests are not counted as new."""
        self._row_of = {key: digest_of(order.whole.to_json()) for key, order in batch.items()}
        self._end_paused(self._row_of.values())
        phase = list(self.phases.values())[-1]
        for key, order in batch.items():
            # A training in parts is one row, so its key is that of the whole.
            if self._row_of[key] not in self.rows:
                phase = replace(phase, trainings=phase.trainings + 1)
                row = TrainingRow(phase=phase.name, number=len(self.rows), label=label_of(Arm(order.settings)))
                self.rows[self._row_of[key]] = row
        self.phases[phase.name] = phase

    def on_record(self, record: Record, order: TrainingRequest, trained: bool) -> None:
        """Record that a training, or a part of a training, is in the ledger."""
        # A search that goes on comes by earlier records again.
        if record.key in self._heard:
            return
        self._heard.add(record.key)
        which = self._row_of[record.key]
        row = self.rows[which]
        outcome = Outcome.from_record(order, record)
        score, result = outcome.mean(self.horizon), record.result or {}
        seconds = float(record.measured.get("seconds", 0.0))
        row = replace(
            row,
            score=score if score == score else None,  # NaN is not equal to itself
            seconds=round(row.seconds + seconds, 3),
            parameters=result.get("parameters"),
            macs_tick=result.get("macs_tick"),
            message=record.message or row.message,
        )
        phase = self.phases[row.phase]
        self.phases[row.phase] = replace(phase, seconds=round(phase.seconds + seconds, 3))
        if trained:
            self._now.add(which)
            self._seconds += seconds
        paused = order.until is not None and outcome.status == "done"
        if paused and row.status == "waiting":
            self._paused[which] = None
            row = replace(row, rung=order.until)
        self.rows[which] = row
        if not paused:
            self._paused.pop(which, None)
            self._end_row(which, outcome.status)
        self.write()

    def _end_row(self, which: str, status: str) -> None:
        """Note the end of a training; a pruned one may be requested again and trained to its end."""
        row = self.rows[which]
        phase = self.phases[row.phase]
        again, pruned = row.status == "pruned", status == "pruned"
        self.phases[row.phase] = replace(
            phase,
            pruned=phase.pruned - again + pruned,
            trained=phase.trained + (not again),
            failed=phase.failed + (status not in ("done", "pruned")),
        )
        # The score of a rung is not to be held against those of whole trainings.
        self.rows[which] = replace(
            row, status=status, score=None if pruned else row.score, rung=row.rung if pruned else None
        )
        if which in self._now:
            self._now.discard(which)
            self.trained += 1

    def _end_paused(self, going_on: Collection[str]) -> None:
        """Mark trainings evaluated at a rung that do not continue as pruned."""
        for which in [one for one in self._paused if one not in going_on]:
            del self._paused[which]
            self._end_row(which, "pruned")

    def on_decision(self, decision: Decision) -> None:
        """Note the end of a phase."""
        earlier = self._before.get(decision.phase)
        self._end_paused(())
        spent, ended = round(time.monotonic() - self._phase_began, 1), _now()
        if earlier is not None:
            # A search that was stopped has spent time before; the longer figure is closer to the truth.
            spent, ended = max(spent, earlier.wall_s), earlier.ended or ended
        self.phases[decision.phase] = replace(self.phases[decision.phase], wall_s=spent, ended=ended)
        self.decisions.append(decision)
        self.write(force=True)

    def end(self, state: str) -> None:
        """Note that the search is finished or stopped."""
        self.state = state
        self.write(force=True)

    def counts(self) -> TrainingCounts:
        """Return the counts of finished trainings, requested trainings and the largest total."""
        done = sum(row.status != "waiting" for row in self.rows.values())
        # A phase that has ended asks for no more.
        ahead = sum(
            max(0, self._expected[name] - self.phases[name].trainings) if name in self.phases else self._expected[name]
            for name in PHASES
            if name not in self.phases or self.phases[name].ended is None
        )
        return TrainingCounts(done, len(self.rows), len(self.rows) + ahead)

    def report(self, progress: Progress) -> None:
        """Report how far the search is, with the time left.

        Args:
            progress: stage whose units are trainings.
        """
        counts = self.counts()
        values = {"share": counts.done / max(1, counts.total), "trained": self.trained, "workers": self.workers}
        # From the trainings of this sitting, or else of earlier ones.
        spent, number = self._seconds, self.trained
        if not number:
            spent, number = sum(row.seconds for row in self.rows.values()), counts.done
        if number:
            values["seconds_left"] = (counts.total - counts.done) * spent / number / self.workers
        progress.step(counts.done, **values)

    def write(self, force: bool = False) -> None:
        """Write it, unless that was done a moment ago."""
        now = time.monotonic()
        if force or now - self._written >= EVERY_S:
            toggles = self.study.spec["toggles"]
            study = replace(
                self.study,
                state=self.state,
                modules={name: title_of(name) for name in (*MODULES, *toggles)},
                decisions=tuple(self.decisions),
                phases=tuple(self.phases.values()),
                history=tuple(self.rows.values()),
                openings=tuple(self.openings),
                counts=self.counts(),
                updated=_now(),
            )
            write_json(self.file, study.to_json())
            self._written = time.monotonic()


@dataclass(frozen=True)
class StudyStatus:
    """Recorded state of a study, and its present worker.

    Attributes:
        study: study with its true state.
        holder: process that coordinates it; None for nobody.
        running: trainings under way.
    """

    study: StudyFile
    holder: str | None
    running: int

    def to_json(self) -> dict[str, object]:
        """Return plain values."""
        return self.study.to_json() | {"holder": self.holder, "running": self.running}


def look_at(folder: str | Path) -> StudyStatus:
    """Return the recorded state of a study, and its present worker.

    Raises:
        StorageError: see `edp.evaluation.study.read_study`.
    """
    study = read_study(folder)
    ledger = Path(folder, "ledger")
    holder = find_holder(ledger / ".lock")
    # Claims of a dead coordinator are stale.
    claims = entries_of(ledger / "claims", "*.lock") if holder else []
    if study.state == "running" and holder is None:
        study = replace(study, state="killed")
    return StudyStatus(study, holder, len(claims))


def label_of(arm: Arm) -> str:
    """Return a short name of a training: backbone, feature set, and additional modules."""
    features = arm["task.features"]
    cell, head = arm.get("model.backbone.cell.kind", "lstm"), arm.get("model.head.kind", "mlp")
    activation = arm.get("model.activation.kind", "identity")
    extra = [] if cell == "lstm" else [cell]
    extra += [block["kind"] for block in arm["model.blocks"]]
    extra += ["physics"] if arm.get("model.physics") else []
    extra += ["zoneout"] if arm.get("model.backbone.zoneout") else []
    extra += [f"{head} head"] if head != "mlp" else []
    extra += ["deeper head"] if arm.get("model.head.layers", 1) > 1 else []
    extra += [] if activation == "identity" else [activation]
    name = features if isinstance(features, str) else features["name"]
    return " + ".join([f"{arm['model.backbone.kind']} {name}", *extra])


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
