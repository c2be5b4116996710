"""Result of a fleet report: the content of ``fleet_report.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from edp import __version__

SCHEMA = 1


@dataclass(frozen=True)
class ErrorDrift:
    """Change of the error from the first half of the time to the second.

    Attributes:
        ratio: mean error of the second half over that of the first.
        t: Welch's t between the blocks of both halves.
    """

    ratio: float
    t: float


@dataclass(frozen=True)
class InputSpread:
    """Mean and standard deviation of an input, SI units."""

    mean: float
    std: float


@dataclass(frozen=True)
class RecordingError:
    """Mean absolute error of one recording."""

    name: str
    mae: float


@dataclass(frozen=True)
class MachineAlarms:
    """Reports of a monitor on a machine.

    Attributes:
        changes: alarms that say the same count once.
        alarms: all of them.
        hours: duration of the recordings.
        first: sentences of the first changes.
        failed: why the monitor could not watch; empty if it did.
    """

    changes: int = 0
    alarms: int = 0
    hours: float = 0.0
    first: tuple[str, ...] = ()
    failed: str = ""

    def to_json(self) -> dict[str, object]:
        """Return plain JSON values."""
        if self.failed:
            return {"failed": self.failed}
        return {name: value for name, value in asdict(self).items() if name != "failed"}


@dataclass(frozen=True)
class MachineErrors:
    """Errors, drift, inputs and alarms of a machine.

    Attributes:
        mae: mean absolute error over outputs and samples, report units.
        by_target: errors of each output.
        persistence: error of taking the present value.
        recordings: error of each recording.
        drift: None where the recordings are too short to tell.
        inputs: inputs by name.
        own: whether the network is the machine's own.
        alarms: None without a monitor.
    """

    mae: float
    by_target: tuple[float, ...]
    persistence: float
    recordings: tuple[RecordingError, ...]
    drift: ErrorDrift | None
    inputs: Mapping[str, InputSpread]
    own: bool
    alarms: MachineAlarms | None


@dataclass(frozen=True)
class ReportedMachine:
    """A machine of a fleet report.

    Attributes:
        machine: name of the machine.
        minutes: duration of its recordings.
        errors: None if it could not be evaluated.
        failed: why it could not.
    """

    machine: str
    minutes: float
    errors: MachineErrors | None = None
    failed: str = ""

    def to_json(self) -> dict[str, object]:
        """Return plain JSON values."""
        head = {"machine": self.machine, "minutes": self.minutes}
        if self.errors is None:
            return head | {"failed": self.failed}
        alarms = self.errors.alarms
        return head | asdict(self.errors) | {"alarms": None if alarms is None else alarms.to_json()}


@dataclass(frozen=True)
class ReportedNetwork:
    """Network of a fleet report: its path, content address of its weights, and its description."""

    path: str
    weights: str
    label: str


@dataclass(frozen=True)
class ReportedTarget:
    """Output with its report unit."""

    name: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class FleetReport:
    """Every machine of a store under one network.

    Attributes:
        edp: version that evaluated them.
        network: network of the fleet.
        store: path of the store.
        deltas: folder of deltas; None without them.
        monitor: folder of a monitor; None without one.
        horizon: samples that are predicted ahead.
        rate_hz: samples per second.
        targets: outputs.
        machines: machines in the order of the store.
    """

    edp: str = __version__
    network: ReportedNetwork
    store: str
    deltas: str | None
    monitor: str | None
    horizon: int
    rate_hz: float
    targets: tuple[ReportedTarget, ...]
    machines: tuple[ReportedMachine, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return the content of ``fleet_report.json``."""
        machines = [machine.to_json() for machine in self.machines]
        return {"schema": SCHEMA, **asdict(self), "machines": machines}
