"""Whether the causes that a monitor names are those of the faults."""

from __future__ import annotations

import numpy as np

from edp.monitor.alarms import MonitorAlarm
from edp.sim.faults import FAULTS, parse_fault
from monitor_sessions import session_facts
from monitor_watching import Plan


def naming(plan: Plan, found: dict[str, list[MonitorAlarm]]) -> dict[str, float]:
    """Shares of the found faults whose first alarm names the component, kind and site, among three, and the place.

    Empty without a diagnosis.
    """
    hits: dict[str, list[bool]] = {key: [] for key in ("component", "top_three", "kind_and_site", "place")}
    for name, alarms in found.items():
        fault = parse_fault(session_facts(plan.data / "test", name)[0].fault)
        after = [alarm for alarm in alarms if alarm.raised_s > fault.onset_s]
        if not after:
            continue
        causes = after[0].causes
        parts = [component(cause.kind, cause.site) for cause in causes]
        right = component(fault.kind, fault.site)
        hits["component"].append(parts[:1] == [right])
        hits["top_three"].append(right in parts[:3])
        hits["kind_and_site"].append([(c.kind, c.site) for c in causes[:1]] == [(fault.kind, fault.site)])
        hits["place"].append([cause.at_fault for cause in causes[:1]] == [place_of(fault.kind)])
    diagnosed = any(alarm.causes for alarms in found.values() for alarm in alarms)
    return {key: float(np.mean(values)) for key, values in hits.items()} if diagnosed else {}


def component(kind: str, site: str) -> str:
    """The part that a mechanic would look at."""
    if kind not in FAULTS:
        return kind
    of = getattr(FAULTS[kind], "component", None)
    return str(of(site)) if of is not None else f"{kind} {site}"


def place_of(kind: str) -> str:
    """Whether a fault is one of the machine or of a sensor."""
    return "sensor" if hasattr(FAULTS[kind], "operation") else "machine"
