"""All export forms of a run: networks, controllers, observers and monitors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from edp.errors import ConfigError, closest
from edp.logs.source import DataSource
from edp.workflows.deployment import export_bundle, forms, unheld_adaptation
from edp.workflows.monitor.export_monitor import export_monitor, holds_monitor

NETWORK, MONITOR = "predictor", "monitor"
"""Names of what is exported where none is given."""


@dataclass(frozen=True, kw_only=True)
class ExportOrder:
    """Request of an export.

    Attributes:
        run: bundle, run folder, or a monitor.
        to: name of the form.
        folder: output folder. An earlier export in it is replaced.
        name: name in the exported files; empty for the default of the form.
        options: options of the form.
        twin: run folder of a grey box, of a form that follows the machine.
        calibration: recordings on which a twin is brought into W8A16.
    """

    run: Path
    to: str
    folder: Path
    name: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    twin: Path | None = None
    calibration: DataSource | None = None


@dataclass(frozen=True)
class RunForm:
    """Form of a run that is more than a network.

    Attributes:
        summary: description in one line.
        name: default name in the exported files.
        write: writes it; returns the files, the one to read first in front.
        follows: whether it reads the grey box of `ExportOrder.twin`.
    """

    summary: str
    name: str
    write: Callable[[ExportOrder], list[Path]]
    follows: bool = False


@dataclass(frozen=True)
class Exported:
    """Result of an export.

    Attributes:
        files: the one to read first in front.
        name: name in the files.
        without_adaptation: whether the form left an adaptation out.
    """

    files: list[Path]
    name: str
    without_adaptation: bool = False


def _controller(order: ExportOrder) -> list[Path]:
    # Here and below: only who exports it loads what it needs.
    from edp.workflows.control import export_controller

    return export_controller(order.run, order.folder, order.name, order.options)


def _follower(order: ExportOrder) -> list[Path]:
    from edp.workflows.adaptation import export_follower

    if order.twin is None:
        raise ConfigError(
            f"--format {order.to} needs --twin GREY, the run of a grey box (edp twin --set twin.kind=greybox)"
        )
    return export_follower(order.run, order.twin, order.folder, order.name, order.options)


RUN_FORMS: Mapping[str, RunForm] = {
    "controller": RunForm(
        "C99, float32: the controller of a run of edp loop run, with model and solver", "machine", _controller
    ),
    "follower": RunForm(
        "C99, float64: a grey box that follows the machine, and moves a network's predictions",
        "follower",
        _follower,
        follows=True,
    ),
}
"""Forms of a run by name."""


def all_forms() -> dict[str, str]:
    """Return every form by name with a description in one line."""
    return {**forms(), **{name: form.summary for name, form in RUN_FORMS.items()}}


def export_run(order: ExportOrder) -> Exported:
    """Write a run in a form of `all_forms`.

    Raises:
        EdpError: an unknown form or option, one that the form does not have, or a run that this form cannot hold.
    """
    if order.to not in all_forms():
        raise ConfigError(
            f"unknown export target '{order.to}'{closest(order.to, all_forms())}; `edp export --formats` lists them"
        )
    form, monitor = RUN_FORMS.get(order.to), holds_monitor(order.run)
    if order.twin is not None and (form is None or not form.follows):
        reading = ", ".join(name for name, other in RUN_FORMS.items() if other.follows)
        raise ConfigError(
            f"--twin: the form '{order.to}' reads no grey box beside the run, {reading} does; leave it out"
        )
    if order.calibration is not None and (monitor or form is not None):
        raise ConfigError("--w8a16: only twins are brought into W8A16 while they are exported; leave it out")
    if monitor:
        name = order.name or MONITOR
        return Exported(export_monitor(order.run, order.to, order.folder, name, order.options), name)
    if form is not None:
        name = order.name or form.name
        return Exported(form.write(replace(order, name=name)), name)
    name = order.name or NETWORK
    files = export_bundle(order.run, order.to, order.folder, name, order.options, order.calibration)
    return Exported(files, name, unheld_adaptation(order.run, order.to))
