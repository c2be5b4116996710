"""Content of ``fleet.json``: the network of each machine of a fleet, as a change of the fleet's network."""

from __future__ import annotations

import re
from dataclasses import dataclass

from edp.errors import ConfigError
from edp.settings.bounds import check_bounds, integer, span
from edp.settings.results import ResultFile

ERROR = span(0.0, 1e30)
DELTA_FILE = re.compile(r"deltas/[0-9a-f]{24}\.delta")


@dataclass(frozen=True, kw_only=True)
class DeltaErrors:
    """Mean absolute errors at the first horizon on the ends of a machine's recordings, in the unit of the file.

    Attributes:
        before: error of the fleet's network.
        full: error of the fine-tuned network.
        delta: error of the fleet's network with the stored change.
    """

    before: float
    full: float
    delta: float

    def __post_init__(self) -> None:
        check_bounds("mae", self, before=ERROR, full=ERROR, delta=ERROR)


@dataclass(frozen=True, kw_only=True)
class MachineDelta:
    """Fine-tuning of one machine.

    Attributes:
        machine: name of the machine.
        minutes: length of its recordings.
        failed: reason why it has no network; the fields that follow are then None.
        bytes: size of the stored change.
        rank: rank of the stored change.
        trained_min: length of the recordings that trained.
        mae: errors.
        delta: name of the file with the change, relative to the folder.

    Raises:
        ConfigError: `delta` is not the name of a file that a fine-tuning writes.
    """

    machine: str
    minutes: float
    failed: str | None = None
    bytes: int | None = None
    rank: int | None = None
    trained_min: float | None = None
    mae: DeltaErrors | None = None
    delta: str | None = None

    def __post_init__(self) -> None:
        # Readers open this file: a path could lead out of the folder.
        if self.delta is not None and not DELTA_FILE.fullmatch(self.delta):
            raise ConfigError(
                f"machine: got '{self.delta[:80]}' as delta, expected deltas/<24 hexadecimal digits>.delta"
            )


@dataclass(frozen=True, kw_only=True)
class FleetFile(ResultFile):
    """Content of ``fleet.json``.

    Attributes:
        edp: version of EDP that wrote the file.
        base: hash of the weights of the fleet's network.
        source: path of the fleet's network.
        store: path of the recordings.
        method: method of the fine-tuning.
        most_bytes: size that no change exceeds.
        unit: unit of the errors.
        horizon: horizon of the errors, in samples.
        rate_hz: sample rate of the recordings.
        machines: result of each machine.
    """

    NAME = "fleet.json"
    SCHEMA = 1
    WHAT = "fleet"
    ADVICE = "remove the folder and run edp train finetune --fleet"

    edp: str
    base: str
    source: str
    store: str
    method: str
    most_bytes: int
    unit: str
    horizon: int
    rate_hz: float
    machines: tuple[MachineDelta, ...]

    def __post_init__(self) -> None:
        check_bounds("fleet", self, most_bytes=integer(0, 2**40), horizon=integer(0, 10**9), rate_hz=span(0.0, 1e9))

    @property
    def errors(self) -> dict[str, DeltaErrors]:
        """Errors of the machines that have a network, by name."""
        return {row.machine: row.mae for row in self.machines if row.mae is not None}
