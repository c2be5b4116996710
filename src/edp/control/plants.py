"""Plants by one argument: the simulator, a twin that was trained on recordings, or an FMU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edp.control.fmu.environment import FmuEnvironment
from edp.control.twin_environment import TwinEnvironment
from edp.errors import ConfigError
from edp.networks.twin import Twin
from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import load_machine
from edp.training.twin_bundle import STROKES, TwinBundle, load_twin
from edp.wording import setting_text, typed

FMU = ".fmu"
SAME_STROKE = 0.01
"""Maximum relative difference between a stroke and the stroke of the twin's machine file, which may be measured."""


def is_fmu(plant: str | Path) -> bool:
    """Return whether a plant is an FMU, by the ending of its file."""
    return Path(plant).suffix.lower() == FMU


def check_trusted(fmu: str | Path, trusted: bool) -> None:
    """Refuse an FMU that the caller does not trust.

    Raises:
        ConfigError: it is not trusted.
    """
    if not trusted:
        raise ConfigError(f"FMU '{fmu}' is native code, which runs with your rights; pass trusted=True if you do")


def plant_of(
    machine: str, duration_s: float, rate_hz: float, plant: str | Path | None = None, trusted: bool = False
) -> Any:
    """Create an environment for running a controller.

    Args:
        machine: name of a machine, or path of a machine file: simulated, or the kinematics of another plant.
        duration_s: longest loop.
        rate_hz: sampling rate in Hz.
        plant: run folder of a twin, or an FMU, that takes the simulator's place.
        trusted: an FMU is native code that runs with the rights of this process; it is not loaded without this.

    Raises:
        EdpError: gymnasium is not installed, or the plant cannot be used, or is of another rate or machine.
    """
    if plant is None:
        return ExcavatorEnv(EnvironmentSpec(machine=machine, duration_s=duration_s, rate_hz=rate_hz))
    if is_fmu(plant):
        check_trusted(plant, trusted)
        return FmuEnvironment(plant, machine, duration_s, rate_hz)
    bundle = bundle_of(plant, load_machine(machine), rate_hz)
    return TwinEnvironment(bundle.twin, machine, duration_s, bundle.ground)


def twin_of(run: str | Path, machine: Machine, rate_hz: float | None = None) -> Twin:
    """Return the twin of a run folder; arguments and errors as in `bundle_of`."""
    return bundle_of(run, machine, rate_hz).twin


def bundle_of(run: str | Path, machine: Machine, rate_hz: float | None = None) -> TwinBundle:
    """Return the twin of a run folder, with its ground if it has one.

    Args:
        run: folder.
        machine: expected machine of the twin.
        rate_hz: expected sample rate; None for any.

    Raises:
        EdpError: there is none, it learned from a machine with other cylinders, or it is of another rate.
    """
    bundle = load_twin(run)
    theirs, ours = bundle.provenance.more.get(STROKES), np.array(machine.cylinders.stroke)
    # Logs of real machines do not say it.
    if isinstance(theirs, list) and all(isinstance(m, int | float) for m in theirs):
        strokes = np.array(theirs, float)
        if strokes.shape != ours.shape or not np.allclose(strokes, ours, rtol=SAME_STROKE):
            texts = [", ".join(f"{m:.3f}" for m in row) for row in (strokes, ours)]
            raise ConfigError(
                f"twin '{run}' learned from a machine whose cylinders have strokes of {texts[0]} m, those of "
                f"{machine.name} have {texts[1]} m; name its machine with --machine, or let it go on with "
                "recordings of this one: edp twin LOGS --start RUN"
            )
    if rate_hz is not None:
        check_rate(bundle.twin, f"twin '{run}'", rate_hz)
    return bundle


def check_rate(twin: Twin, what: str, rate_hz: float) -> Twin:
    """Return the twin after a check of its sampling rate.

    Raises:
        ConfigError: it has another one.
    """
    own = twin.channels.rate_hz
    if own != rate_hz:
        raise ConfigError(
            f"{what} has {typed(own)} Hz, the loops {typed(rate_hz)} Hz; set rate_hz = {setting_text(own)}"
        )
    return twin
