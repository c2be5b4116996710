"""Does the monitor find the faults of an M22, at the rate of false alarms that it promises, and name them?

A monitor is fitted by `edp.workflows.monitor` to healthy sessions (`benchmarks/monitor_sessions.py`) and watches
sessions of unseen seeds: healthy ones, every kind and size of fault at drawn sites, and healthy ones that must stay
silent. Its rivals are fitted to the same sessions and get their limits from the same ones, for the same rate. PyOD's
two were the best of seven on the validation part (`--choose`).

A fault is found by an alarm after its onset; an alarm before it is a false one. Delays are seconds in which the machine
moved. The promise: 20 fits of conditioning, whitening and limit to other healthy sessions each, with the same residuals
(their networks take longer), measured on the sessions that were left out. Sets that must stay
silent are judged by the same monitor without balances of flow, too: it shares all but what lies behind the residuals.

All parts run in `--workers` processes and say what they found as soon as they have it, a line of JSON each, so that a
run which is cut off tells what it had. `--seconds` ends a run before that: fits of the promise and rivals that would
begin later are left out.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common import finish, finite, in_folder, parser
from edp.monitor.alarms import MonitorAlarm
from edp.monitor.monitor_file import load_monitor
from edp.monitor.residuals.base import SideBySide
from edp.sandbox.helpers import Helpers
from monitor_metrics import Case, curves, false_alarm_rate, judged, summary
from monitor_naming import naming
from monitor_progress import BEGAN, Beside, say
from monitor_promise import FITS, promise
from monitor_rival_runs import choose, rival_results
from monitor_sessions import DURATION_S, NUISANCES, died, session_facts
from monitor_test_set import QUICK_HOURS, QUICK_SECONDS, test_names, write_test, write_training
from monitor_verdicts import show
from monitor_watching import (
    Plan,
    add_dictionary,
    columns_without_flow,
    fit_without_flow,
    fitted,
    same_alarms,
    summarise,
    watched,
)

QUICK_SETTINGS = (
    'chain.watches=[{detector={kind="cusum"}, memory_s=4.0}]',
    'dictionary.machine="none"',
    'residuals=[{kind="virtual_sensors", units=16, lags_s=[0.04, 0.16]}, {kind="balances"}]',
)
"""Averages over a minute need more than minutes, and faults that are simulated half an hour."""


def our_cases(plan: Plan, found: dict[str, list[MonitorAlarm]]) -> list[Case]:
    """What was found of the faulty sessions."""
    cases = []
    for name, alarms in found.items():
        session, moving = session_facts(plan.data / "test", name)
        cases.append(judged(session.fault, moving, [alarm.raised_s for alarm in alarms]))
    return cases


@dataclass(frozen=True)
class _Start:
    label: str


def _started(job: _Start) -> str:
    return job.label


def measure(plan: Plan, seed: int, side_by_side: SideBySide) -> dict[str, Any]:
    """Everything of one run."""
    write_training(plan, side_by_side)
    # Test sessions are simulated beside the fit, and faults of the dictionary beside what is judged: each of these
    # alone leaves processes idle.
    simulating = Beside(lambda: write_test(plan, side_by_side))
    if plan.workers == 1:
        simulating.result()
    found: dict[str, Any] = {"fit": fitted(plan, side_by_side)}
    say("fit", found["fit"])
    learning = Beside(lambda: add_dictionary(plan, side_by_side))
    if plan.workers == 1:
        learning.result()
    simulating.result()
    names = test_names(plan)
    summarise(plan, [name for group in names.values() for name in group], side_by_side)
    wrong = watched(plan, names["faulty"], side_by_side)
    found |= judgement(plan, names, wrong, side_by_side)
    say("the monitor", {key: value for key, value in found.items() if key != "fit"})
    causes = Beside(lambda: named(plan, wrong) if learning.result() else {})
    found["without_flow"] = without_flow(plan, names, side_by_side)
    found["promise"] = promise(plan, seed, side_by_side)
    found["same_alarms"] = same_alarms(plan, wrong, 2)
    found["naming"] = settled("causes", causes, plan) or {}
    found["rivals"] = rival_results(plan, names, side_by_side)
    return found


def settled(what: str, work: Beside, plan: Plan) -> Any:
    """The result of work beside the run; None where the time is over before."""
    while not work.done() and time.monotonic() - BEGAN < plan.until:
        time.sleep(0.2)
    if not work.done():
        print(f"{what}: left out, the time is over")
        return None
    return work.result()


def rates_of(
    plan: Plan, names: Mapping[str, Sequence[str]], alarms: Mapping[str, Sequence[MonitorAlarm]]
) -> dict[str, dict[str, Any]]:
    """False alarms of each set that is healthy."""
    seconds = QUICK_SECONDS if plan.quick else DURATION_S
    return {
        group: dict(finite(false_alarm_rate(sum(len(alarms[n]) for n in some), len(some) * seconds / 3600.0)))
        for group, some in names.items()
        if group != "faulty"
    }


def judgement(
    plan: Plan, names: Mapping[str, Sequence[str]], wrong: dict[str, list[MonitorAlarm]], side_by_side: SideBySide
) -> dict[str, Any]:
    """What the monitor finds, and its false alarms on every set that is healthy."""
    cases = our_cases(plan, wrong)
    healthy = [name for group, some in names.items() if group != "faulty" for name in some]
    rates = rates_of(plan, names, watched(plan, healthy, side_by_side))
    sets = {group: rate for group, rate in rates.items() if group != "healthy"}
    return {"ours": summary(cases), "curves": curves(cases), "healthy": rates["healthy"], "nuisance": sets}


def without_flow(plan: Plan, names: Mapping[str, Sequence[str]], side_by_side: SideBySide) -> dict[str, Any]:
    """False alarms of the same monitor without balances of flow in sets that must stay silent.

    Empty where it has none, or nothing else.
    """
    monitor = load_monitor(plan.monitor)
    kept, _, columns = columns_without_flow(monitor)
    if not kept or len(kept) == len(monitor.sources):
        return {}
    fit_without_flow(plan, side_by_side)
    sets = {group: some for group, some in names.items() if group in NUISANCES}
    all_names = [name for some in sets.values() for name in some]
    found = rates_of(plan, sets, watched(plan, all_names, side_by_side, plan.without_flow, columns))
    say("without balances of flow", found)
    return found


def named(plan: Plan, wrong: dict[str, list[MonitorAlarm]]) -> dict[str, float]:
    """`naming` of the monitor with its dictionary, in the sessions in which the monitor raises an alarm."""
    found = naming(plan, watched(plan, [name for name, alarms in wrong.items() if alarms], map, plan.named))
    say("causes", found)
    return found


def main() -> None:
    options = parser(__doc__ or "")
    options.add_argument("--monitor", type=Path, default=None, help="folder of the monitor; default: in --data")
    options.add_argument("--hours", type=float, default=8.0, help="operating hours to one false alarm, promised")
    options.add_argument("--minutes", type=float, default=5.0, help="processor time of the monitor's networks")
    options.add_argument("--sessions", type=int, default=150, help="healthy sessions that are fitted to")
    options.add_argument("--fits", type=int, default=FITS, help="of the promise; 0 leaves it out")
    options.add_argument("--workers", type=int, default=1, help="processes")
    options.add_argument("--seconds", type=float, default=1e9, help="begin nothing further after so many")
    options.add_argument("--set", action="append", default=[], help="a setting of the monitor")
    options.add_argument(
        "--choose", action="store_true", help="compare PyOD's detectors on the validation part instead"
    )
    given = options.parse_args()

    def run(folder: Path) -> None:
        plan = Plan(
            folder, given.monitor or folder / "monitor", given.hours, given.minutes, given.sessions, given.workers,
            given.quick, tuple(given.set), given.fits, given.seconds,
        )  # fmt: skip
        if given.quick:
            plan = replace(plan, hours=QUICK_HOURS, minutes=0.05, settings=(*QUICK_SETTINGS, *plan.settings))
        with Helpers(plan.workers, died) as helpers:
            # Processes end with the thread that starts them: work beside the run must find them all there.
            list(helpers.ordered(_started, [_Start(f"process {n + 1}") for n in range(plan.workers)]))
            if given.choose:
                choose(plan, helpers.ordered)
                return
            found = measure(plan, given.seed, helpers.ordered)
        finish("monitor", show(found, plan), given.seed, finite(found))

    # The short form has other sessions under the same names.
    in_folder(given.data / "quick" if given.quick and given.data else given.data, run)


if __name__ == "__main__":
    main()
