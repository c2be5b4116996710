"""Monitor as FMUs of FMI 2.0 and 3.0: measurements as inputs; alarm, statistics and counts as outputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from edp.export.description import as_json
from edp.export.escape import visible
from edp.export.fmu.assemble import check_choice, fmu_files, model_header, token_of
from edp.export.fmu.describe import About
from edp.export.fmu.interface import Variable, unique
from edp.export.folder import write_export
from edp.export.monitor.describe import description
from edp.export.monitor.parts import MonitorParts
from edp.export.monitor.write import monitor_files
from edp.export.si_names import si_channels

STATUS = "0 judged; 1 warming up: blocks after a reset that are not judged; 2 an input is missing, residuals are silent"
OUTPUTS = (
    ("alarm", "1 from an alarm to the next verdict, else 0"),
    ("alarms", "alarms since the reset"),
    ("since_s", "seconds before the end of the block of the last alarm at which the deviation began"),
    ("silent", "residuals without a value at this tick"),
)
COUNTS = (
    ("rejected", "ticks with an input that was missing since the reset"),
    ("held", "missed ticks since the reset"),
    ("restarts", "times the networks forgot the past since the reset"),
)


def monitor_variables(parts: MonitorParts) -> list[Variable]:
    """Return inputs and outputs in the order of the monitor's C structures, then the variables of the FMU itself."""
    spread = 1.0 / parts.chain.summaries.spread
    inputs = [
        Variable(c.name, "input", c.description, kind=c.kind, nominal=float(f"{abs(width):.3g}") or 1.0)
        for c, width in zip(si_channels(parts.inputs), spread, strict=True)
    ]
    outputs = [Variable(name, "output", text) for name, text in OUTPUTS]
    statistics = [
        Variable(f"statistic_{i}", "output", f"of {watch.detector} {i}, over the limit: an alarm where it passes 1")
        for i, watch in enumerate(parts.watches)
    ]
    own = [Variable("status", "output", STATUS, "whole")]
    own.append(Variable("valid", "output", "true if this tick is judged and no input is missing", "flag"))
    own += [Variable(name, "local", text, "whole") for name, text in COUNTS]
    return unique([*inputs, *outputs, *statistics, *own])


def write_monitor_fmu(parts: MonitorParts, name: str, folder: Path, options: Mapping[str, str]) -> list[Path]:
    """Write FMUs of a monitor under `folder`, in place of the export that it holds.

    Args:
        parts: its numbers.
        name: name of the model.
        folder: made when absent.
        options: ``version`` and ``binaries`` as of the target `fmu`.

    Raises:
        ExportError: the name, an option or a part cannot be written, or there is no compiler.
        StorageError: the folder cannot be written.
    """
    version, binaries = options.get("version", "both"), options.get("binaries", "both")
    check_choice(version, binaries)
    listed = monitor_variables(parts)
    core = dict(monitor_files(parts, name).texts())
    facts = {"monitor_hash": parts.digest, "promise": visible(parts.promise)}
    token = token_of((*core.values(), repr(listed)))
    about = About(name, token, visible(parts.title), parts.rate_hz, listed, False, facts)
    # Inputs that were never set are missing, as those that are NaN.
    core["fmu_model.h"] = model_header(about, required=len(parts.inputs))
    return write_export(folder, fmu_files(about, core, as_json(description(parts, name)), version, binaries))
