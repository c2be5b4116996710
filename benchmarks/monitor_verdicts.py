"""Tables and verdicts of the monitor's benchmark."""

from __future__ import annotations

from typing import Any

from common import Verdict, table, verdict
from monitor_promise import FITS
from monitor_watching import Plan

GOALS = {
    "found": 0.8,
    "found_large": 0.95,
    "delay_s": 60.0,
    "delay_largest_s": 10.0,
    "over_rival": 5.0,
    "component": 0.85,
    "top_three": 0.95,
    "place": 0.95,
    "fits": 18,
}


def show(found: dict[str, Any], plan: Plan) -> list[Verdict]:
    """Tables and verdicts."""
    quick, ours = plan.quick, found["ours"]
    rows = [_row("edp.monitor", ours, found["healthy"])]
    rows += [_row(name, rival, rival["false"]) for name, rival in found["rivals"].items()]
    print(
        "\nall kinds and sizes; false alarms on healthy test sessions" + (" (quick: hardly trained)" if quick else "")
    )
    table(["detector", "found", "two largest", "delay, s", "largest, s", "false alarms", "hours", "in 8 h"], rows)
    print("\nshare found by size; size found in half of the cases")
    table(
        ["kind", "found", "half", "unit", "delay, s"],
        [
            [kind, ", ".join(f"{s}: {v:.2f}" for s, v in c["found"].items()), c["half"], c["unit"], c["delay_s"]]
            for kind, c in found["curves"].items()
        ],
    )
    print("\nhealthy sessions that must stay silent")
    sets, others = found["nuisance"].items(), found["without_flow"]
    table(
        ["set", "false alarms", "hours", "in 8 h", "alarms without balances of flow"],
        [[n, r["alarms"], r["hours"], r["in_8_h"], others[n]["alarms"] if others else "-"] for n, r in sets],
    )
    return verdicts(found, plan)


def _row(name: str, figures: dict[str, Any], false: dict[str, Any]) -> list[object]:
    keys = ("found", "found_large", "delay_s", "delay_largest_s")
    return [name, *(figures[key] for key in keys), false["alarms"], false["hours"], false["in_8_h"]]


def verdicts(found: dict[str, Any], plan: Plan) -> list[Verdict]:
    """The goals, one by one."""
    quick, ours, goals = plan.quick, found["ours"], GOALS
    # A rival that raises more false alarms than promised is no rival at this rate: it is shown, not taken.
    best = max((r["found"] for r in found["rivals"].values()), default=None)
    rate = found["healthy"]["in_8_h"]
    result = [
        verdict("false alarms in 8 h, healthy sessions", rate, 8.0 / plan.hours, "<= 1", "alarms", quick),
        verdict("faults found, all kinds and sizes", ours["found"], goals["found"], ">= 1", "share", quick),
        verdict("of the two largest sizes", ours["found_large"], goals["found_large"], ">= 1", "share", quick),
        verdict("median delay", ours["delay_s"], goals["delay_s"], "<= 1", "s of motion", quick),
        verdict("of the largest size", ours["delay_largest_s"], goals["delay_largest_s"], "<= 1", "s of motion", quick),
    ]
    if best is not None:
        over = f">= {goals['over_rival']:g}"
        result.append(verdict("found, over the best rival", ours["found"], best, over, "share", quick))
    for group, row in found["nuisance"].items():
        result.append(
            verdict(f"{group}: false alarms in 8 h", row["in_8_h"], 8.0 / plan.hours, "<= 2", "alarms", quick)
        )
    named = found["naming"]
    if not named:
        print("no alarm names a cause: this monitor has no diagnosis")
    for key in ("component", "top_three", "place") if named else ():
        result.append(verdict(f"named right: {key}", named[key], goals[key], ">= 1", "share", quick))
    fits = found["promise"]
    if not fits["of"]:
        return result
    wanted = goals["fits"] * fits["of"] / FITS
    result.append(verdict("fits whose interval holds the rate", float(fits["within"]), wanted, ">= 1", "fits", quick))
    return result
