"""The monitor's rivals on the sessions that it is judged on."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from common import kept
from edp.monitor.residuals.base import SideBySide
from monitor_metrics import false_alarm_rate, judged, summary
from monitor_rivals import CHARTS, PYOD, Floats, Rival, has_pyod, limit_of, raised, rivals_of
from monitor_sessions import read_session, session_facts
from monitor_watching import BEGAN, Plan, parts_of, say


def rival_rows(plan: Plan, rivals: Mapping[str, Rival], folder: str, names: Sequence[str]) -> dict[str, list[Floats]]:
    """White rows of sessions of every rival; each session is read once."""
    rows: dict[str, list[Floats]] = {name: [] for name in rivals}
    for number, session in enumerate(names, start=1):
        values = read_session(plan.data / folder, session).recording.values
        for name, rival in rivals.items():
            rows[name].append(rival.rows(values))
        if number % 50 == 0:
            print(f"rivals: {number} of {len(names)} of {folder}", flush=True)
    return rows


@dataclass(frozen=True)
class _RivalJob:
    plan: Plan
    rival: str
    healthy: tuple[str, ...]
    faulty: tuple[str, ...]

    @property
    def label(self) -> str:
        """For messages."""
        return self.rival


def rival_result(job: _RivalJob) -> dict[str, dict[str, Any]]:
    """Evaluate a reference method on the same sessions, with each of its charts."""
    plan = job.plan
    learning, limiting = parts_of(plan)
    # Forty sessions are 5 h: what is linear or of neighbours has seen all there is to see by then.
    material = [read_session(plan.data / "training", name).recording.values for name in learning[:40]]
    rate = 1.0
    rivals = {job.rival: rivals_of(tuple(PYOD) if job.rival.startswith("PyOD") else ())[job.rival]}
    rivals[job.rival].fit(material, ticks=100)
    held = rival_rows(plan, rivals, "training", limiting)[job.rival]
    calm, wrong = (rival_rows(plan, rivals, "test", names)[job.rival] for names in (job.healthy, job.faulty))
    facts = [session_facts(plan.data / "test", name) for name in job.faulty]
    results: dict[str, dict[str, Any]] = {}
    for chart, spec in CHARTS.items():
        limit = limit_of(spec, held, rate, plan.hours).limit
        false = sum(len(raised(spec, limit, rows, rate)) for rows in calm)
        cases = [
            judged(session.fault, moving, raised(spec, limit, rows, rate))
            for (session, moving), rows in zip(facts, wrong, strict=True)
        ]
        hours = sum(len(rows) for rows in calm) / rate / 3600.0
        results[f"{job.rival}, {chart}"] = summary(cases) | {"false": false_alarm_rate(false, hours)}
    return results


def rival_results(
    plan: Plan, names: Mapping[str, Sequence[str]], side_by_side: SideBySide
) -> dict[str, dict[str, Any]]:
    """Every rival on the same sessions; of an earlier run of the same sessions where there was one."""

    def measured() -> dict[str, Any]:
        rivals = rivals_of(tuple(PYOD) if has_pyod() else ())
        jobs = [_RivalJob(plan, rival, tuple(names["healthy"]), tuple(names["faulty"])) for rival in rivals]
        results: dict[str, dict[str, Any]] = {}
        for result in side_by_side(rival_result, jobs):
            results |= result
            say("rival", result)
        return results

    if time.monotonic() - BEGAN > plan.until:
        print("rivals: left out, the time is over")
        return {}
    return kept(plan.monitor / "rivals.json", measured)
