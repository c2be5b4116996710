"""The promise of the monitor's benchmark: fits to other healthy sessions, measured on those left out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from edp.monitor.fitting import fit_from_blocks
from edp.monitor.residuals.base import SideBySide
from edp.monitor.session_blocks import SessionBlocks
from monitor_progress import BEGAN, say
from monitor_test_set import test_names
from monitor_watching import NEVER_H, MonitorOfBlocks, Plan, blocks_file, monitor_of, parts_of, read_blocks

FITS, FIT_SESSIONS, MEASURED_SESSIONS = 20, 66, 120
"""Of the promise: fits, and sessions that each is fitted to and measured on."""


@dataclass(frozen=True)
class _FitJob:
    plan: Plan
    seed: int
    number: int
    label: str


@lru_cache(maxsize=1)
def pool(plan: Plan) -> tuple[SessionBlocks, ...]:
    """Healthy sessions that no residual was fitted to."""
    held = [blocks_file(plan, "training", name) for name in parts_of(plan)[1]]
    test = [blocks_file(plan, "test", name) for name in test_names(plan)["healthy"]]
    return tuple(read_blocks(path)[0] for path in (*held, *test))


def promise_of(rows: Sequence[dict[str, Any]], plan: Plan) -> dict[str, Any]:
    """Fits of all behind the residuals to other healthy sessions each, and what they raise on others."""
    within = sum(row["low_hours"] <= row["measured_hours"] <= row["high_hours"] for row in rows)
    as_promised = sum(row["measured_hours"] >= plan.fit_hours for row in rows)
    return {
        "fits": list(rows), "within": within, "of": len(rows), "as_promised": as_promised,
        "promised_hours": plan.fit_hours,
    }  # fmt: skip


def _one_fit(job: _FitJob) -> dict[str, Any]:
    # Of processes that were begun later this is an earlier time than the run's, by the seconds of their start.
    if time.monotonic() - BEGAN > job.plan.until:
        return {}
    plan, parts, monitor = job.plan, pool(job.plan), monitor_of(job.plan.monitor)
    order = np.random.default_rng([job.seed, job.number]).permutation(len(parts))
    count = min(FIT_SESSIONS, len(parts) // 2)
    chosen, others = ([parts[i] for i in some] for some in (order[:count], order[count:][:MEASURED_SESSIONS]))
    spec, old = plan.experiment.chain, monitor.chain
    result = fit_from_blocks(spec, old.summaries, chosen, monitor.rate_hz, old.settle, plan.fit_hours)
    own = MonitorOfBlocks.of(monitor, result.chain)
    count = sum(len(own.run(part)) for part in others)  # type: ignore[arg-type]
    measured = sum(len(part.summaries) for part in others) * monitor.block_s / 3600.0
    return {
        "low_hours": result.limit.low_hours,
        "high_hours": min(result.limit.high_hours, NEVER_H),
        # No alarm in H hours: the mean is H at least.
        "measured_hours": measured / max(count, 1),
        "alarms": count,
        "hours": measured,
    }


def promise(plan: Plan, seed: int, side_by_side: SideBySide) -> dict[str, Any]:
    """Fits to other healthy sessions, as many as the time allows."""
    rows: list[dict[str, Any]] = []
    fits = 2 if plan.quick else plan.fits
    jobs = [_FitJob(plan, seed, number, f"fit {number}") for number in range(fits)]
    for row in side_by_side(_one_fit, jobs):
        if row:
            rows.append(row)
            say(f"promise {len(rows)}", row)
    return promise_of(rows, plan)
