"""Progress of a study as plain values in ``study.json``, for its report and for `edp search status`."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from edp.config.experiment import Table
from edp.errors import StorageError
from edp.storage import held_by, read_json, write_json
from edp.storage.ledger import Opening, Record, digest_of
from edp.storage.paths import entries_of
from edp.storage.study_file import FILE, SCHEMA, read_study
from edp.workflows.search.context import Decision, Outcome, SearchContext
from edp.workflows.search.modules import MODULES, title_of
from edp.workflows.search.phases import PHASES
from edp.workflows.search.trainings import TrainingRequest

# Two seconds: a viewer does not follow faster, and a record a second would cost more than it tells.
EVERY_S = 2.0


class StudyLog:
    """Writes down what happens, at most every two seconds but for decisions and the end.

    Rows of trainings stand in the order in which they were asked for, whatever order they ended in, so that a search
    that was stopped and went on writes what one that was not would have written, times apart. A training
    that is done in parts is one row; one whose next part is not asked for with the others of its batch was pruned.

    Args:
        folder: of the study.
        facts: what does not change: mode, preset, data, spec, sessions.
        context: of the search, before any decision.

    Attributes:
        trained: trainings of this sitting.
        decisions: of the phases that have ended.
        openings: openings of the sealed test sets.
        state: ``running``, ``stopped`` or ``finished``.
        workers: trainings that run side by side.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any], context: SearchContext) -> None:
        self.file = folder / FILE
        self.facts = dict(facts)
        self.horizon = context.spec.horizon
        self.decisions: list[Decision] = []
        self.phases: dict[str, dict[str, Any]] = {}
        self.rows: dict[str, dict[str, Any]] = {}
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
        earlier = _held_before(self.file)
        self._before = {phase["name"]: phase for phase in earlier.get("phases", [])}
        self.facts["created"] = earlier.get("created", _now())
        self.state = "running"

    def on_phase(self, name: str, context: SearchContext) -> None:
        """A phase begins."""
        earlier = self._before.get(name, {})
        self._phase_began = time.monotonic()
        self._expected[name] = PHASES[name].trainings(context)
        self.phases[name] = {
            "name": name,
            "title": PHASES[name].title,
            "trainings": 0,
            "trained": 0,
            "failed": 0,
            "pruned": 0,
            "seconds": 0.0,
            "wall_s": 0.0,
            "began": earlier.get("began", _now()),
            "ended": None,
        }
        for later in list(PHASES)[list(PHASES).index(name) + 1 :]:
            self._expected[later] = PHASES[later].trainings(context)
        self.write(force=True)

    def on_batch(self, batch: Mapping[str, TrainingRequest]) -> None:
        """A batch of trainings is asked for, by key; those that were asked for before are no new ones."""
        phase = self._phase
        self._row_of = {key: digest_of(order.whole.to_json()) for key, order in batch.items()}
        self._end_paused(self._row_of.values())
        for key, order in batch.items():
            if self._row_of[key] not in self.rows:
                # A training in parts is one row, so its key is that of the whole.
                phase["trainings"] += 1
                row = {"phase": phase["name"], "number": len(self.rows), "label": label_of(order.settings)}
                self.rows[self._row_of[key]] = row | {"status": "waiting", "seconds": 0.0}

    def on_record(self, record: Record, order: TrainingRequest, trained: bool) -> None:
        """A training, or a part of one, is in the ledger."""
        # A search that goes on comes by earlier records again.
        if record.key in self._heard:
            return
        self._heard.add(record.key)
        which = self._row_of[record.key]
        row = self.rows[which]
        outcome = Outcome.of(order, record)
        score, result = outcome.mean(self.horizon), record.result or {}
        seconds = float(record.measured.get("seconds", 0.0))
        row |= {
            "score": score if score == score else None,  # NaN is not equal to itself
            "seconds": round(row["seconds"] + seconds, 3),
            "parameters": result.get("parameters"),
            "macs_tick": result.get("macs_tick"),
        }
        if record.message:
            row["message"] = record.message
        phase = self.phases[row["phase"]]
        phase["seconds"] = round(phase["seconds"] + seconds, 3)
        if trained:
            self._now.add(which)
            self._seconds += seconds
        if order.until is None or outcome.status != "done":
            self._paused.pop(which, None)
            self._end_row(which, outcome.status)
        elif row["status"] == "waiting":
            self._paused[which] = None
            row["rung"] = order.until
        self.write()

    def _end_row(self, which: str, status: str) -> None:
        """A training is over; one that was pruned may be asked for again, and trained to its end."""
        row = self.rows[which]
        phase = self.phases[row["phase"]]
        if row["status"] == "pruned":
            phase["pruned"] -= 1
        else:
            phase["trained"] += 1
        phase["pruned"] += status == "pruned"
        phase["failed"] += status not in ("done", "pruned")
        row["status"] = status
        if status == "pruned":
            row["score"] = None  # that of a rung is not to be held against those of whole trainings
        else:
            row.pop("rung", None)
        if which in self._now:
            self._now.discard(which)
            self.trained += 1

    def _end_paused(self, going_on: Collection[str]) -> None:
        """What was judged at a rung and is not among what goes on was pruned."""
        for which in [one for one in self._paused if one not in going_on]:
            del self._paused[which]
            self._end_row(which, "pruned")

    def on_decision(self, decision: Decision) -> None:
        """A phase ends."""
        phase, earlier = self._phase, self._before.get(decision.phase, {})
        self._end_paused(())
        spent = time.monotonic() - self._phase_began
        # A search that was stopped has spent time before; the longer figure is closer to the truth.
        phase["wall_s"] = round(max(spent, float(earlier.get("wall_s", 0.0))), 1)
        phase["ended"] = earlier.get("ended") or _now()
        self.decisions.append(decision)
        self.write(force=True)

    def end(self, state: str) -> None:
        """The search is finished, or stopped."""
        self.state = state
        self.write(force=True)

    def counts(self) -> dict[str, int]:
        """Trainings that are done, that were asked for, and that there will be in all at most."""
        done = sum(row["status"] != "waiting" for row in self.rows.values())
        ahead = sum(self._expected[name] for name in PHASES if name not in self.phases)
        current = 0
        if self.phases:
            phase = self._phase
            if phase["ended"] is None:
                current = max(0, self._expected[phase["name"]] - phase["trainings"])
        return {"done": done, "asked": len(self.rows), "total": len(self.rows) + current + ahead}

    def seconds_left(self) -> float | None:
        """From the trainings of this sitting, or else of earlier ones; None before the first."""
        counts = self.counts()
        if self.trained:
            each = self._seconds / self.trained
        elif counts["done"]:
            each = sum(row.get("seconds") or 0.0 for row in self.rows.values()) / counts["done"]
        else:
            return None
        return (counts["total"] - counts["done"]) * each / self.workers

    def to_json(self) -> Table:
        """The whole, plain."""
        return {
            "schema": SCHEMA,
            "state": self.state,
            **self.facts,
            "modules": {name: title_of(name) for name in (*MODULES, *self.facts["spec"]["toggles"])},
            "decisions": [decision.to_json() for decision in self.decisions],
            "phases": list(self.phases.values()),
            "history": list(self.rows.values()),
            "openings": [vars(one) | {"judged": list(one.judged)} for one in self.openings],
            "counts": self.counts(),
            "updated": _now(),
        }

    def write(self, force: bool = False) -> None:
        """Write it, unless that was done a moment ago."""
        now = time.monotonic()
        if force or now - self._written >= EVERY_S:
            write_json(self.file, self.to_json())
            self._written = time.monotonic()

    @property
    def _phase(self) -> dict[str, Any]:
        return list(self.phases.values())[-1]


def look_at(folder: str | Path) -> Table:
    """What a study has written down, and who works on it: ``holder`` (process, None for nobody), ``running``.

    Raises:
        StorageError: as `edp.storage.study_file.read_study`.
    """
    study = dict(read_study(folder))
    ledger = Path(folder, "ledger")
    holder = held_by(ledger / ".lock")
    # Claims of a dead coordinator are stale.
    claims = entries_of(ledger / "claims", "*.lock") if holder else []
    if study["state"] == "running" and holder is None:
        study["state"] = "killed"
    return study | {"holder": holder, "running": len(claims)}


def label_of(settings: Table) -> str:
    """A training in a few words: backbone, feature set, and what else is in the network."""
    task, model = settings["task"], settings["model"]
    features = task["features"] if isinstance(task["features"], str) else task["features"]["name"]
    backbone = model["backbone"]
    cell = backbone.get("cell", {}).get("kind", "lstm")
    extra = [] if cell == "lstm" else [cell]
    extra += [block["kind"] for block in model["blocks"]]
    extra += [part for part in ("physics",) if model.get(part)]
    extra += ["zoneout"] if backbone.get("zoneout") else []
    head = model.get("head", {})
    extra += [f"{head['kind']} head"] if head.get("kind", "mlp") != "mlp" else []
    extra += ["deeper head"] if head.get("layers", 1) > 1 else []
    activation = model.get("activation", {}).get("kind", "identity")
    extra += [] if activation == "identity" else [activation]
    return " + ".join([f"{backbone['kind']} {features}", *extra])


def _held_before(file: Path) -> Table:
    """What an earlier sitting wrote; what cannot be read is written anew, since the ledger holds all that counts."""
    try:
        # The log is for viewers; the ledger holds all that counts.
        content = read_json(file)
    except StorageError:
        return {}
    return content if isinstance(content, dict) and content.get("schema") == SCHEMA else {}


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
