"""Fleet reports made by hand from the tables of their file."""

from __future__ import annotations

from typing import Any

from edp.report.fleet.result import (
    ErrorDrift,
    FleetReport,
    InputSpread,
    MachineAlarms,
    MachineErrors,
    ReportedMachine,
    ReportedNetwork,
    ReportedTarget,
)


def fleet_report(content: dict[str, Any]) -> FleetReport:
    """Return the report of a table in the form of ``fleet_report.json``."""
    machines = []
    for row in content["machines"]:
        head = (row["machine"], row.get("minutes", 0.0))
        if "failed" in row:
            machines.append(ReportedMachine(*head, failed=row["failed"]))
            continue
        alarms = (
            None if row["alarms"] is None else MachineAlarms(**{**row["alarms"], "first": (*row["alarms"]["first"],)})
        )
        inputs = {name: InputSpread(**values) for name, values in row["inputs"].items()}
        errors = MachineErrors(
            row["mae"],
            tuple(row["by_target"]),
            row["persistence"],
            (),
            ErrorDrift(**row["drift"]),
            inputs,
            row["own"],
            alarms,
        )
        machines.append(ReportedMachine(*head, errors))
    names = ("store", "deltas", "monitor", "horizon", "rate_hz", "edp")
    return FleetReport(
        network=ReportedNetwork(**content["network"]),
        targets=tuple(ReportedTarget(**target) for target in content["targets"]),
        machines=tuple(machines),
        **{name: content[name] for name in names},
    )
