"""Settings of an environment: simulation and observations, checked before the first step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.settings.bounds import check_bounds, integer, shown, span
from edp.signals import EXTRA_CHANNELS, GROUND_CHANNELS, TABLE_A1, Channel
from edp.sim.faults import FaultSpec, faults_of
from edp.sim.machine import layout as at
from edp.sim.machine.family import MASSES_T, WIDEST, member_mass
from edp.sim.scenario import START_STROKES, Scenario
from edp.sim.sensors import chain
from edp.sim.sensors.sensors import shown_names, truth_columns
from edp.storage.reading import Table
from edp.wording import typed

OBSERVED = (*TABLE_A1, "CylStroke_1", "CylStroke_2", "CylStroke_3")
"""Default observations: the signals of Table A.1, and the strokes, which are observed without a sensor model."""
MAX_LATENCY = 1000
MAX_SAMPLES = 10_000_000
"""Maximum number of samples of an episode. The random values of an episode are generated at reset, 152 bytes per
sample."""


@dataclass(frozen=True)
class EnvironmentSpec:
    """One environment.

    Attributes:
        machine: name of a machine, or path of a machine file (`.toml`).
        material: soil that the bucket works in; empty for free air.
        duration_s: length of an episode, s, with ``duration_s * rate_hz`` observations including the first one.
        rate_hz: ticks per second.
        step_s: integration step; cut in four near the ends of the stroke.
        sensor_noise: whether observations have sensor errors; False gives the true values.
        hand: whether an operator's hand smooths the levers, as in `Simulation`.
        loop_latency: delay of the observations in samples.
        lost_frames: fraction of the samples at which the previous observation is repeated.
        start_strokes: range of the initial strokes, as fractions of the full stroke.
        observed: names of the observed channels, of Table A.1 or of the additional channels that `simulate` logs.
        sensors: values that replace those of the machine's ``[sensors]``, by key.
        randomise: whether each reset chooses a random machine of the M22 family; a number also scales the scatter.
        masses_t: range of the masses of that family.
        faults: faults of machine and sensors, each as a text or as a table, see `edp.sim.faults`.

    Raises:
        ConfigError: a value is out of range, or a machine, material or channel is unknown (the closest is offered).
    """

    machine: str = "M22"
    material: str = ""
    duration_s: float = 60.0
    rate_hz: float = 100.0
    step_s: float = 2.5e-3
    sensor_noise: bool = True
    hand: bool = False
    loop_latency: int = 0
    lost_frames: float = 0.0
    start_strokes: tuple[float, float] = START_STROKES
    observed: tuple[str, ...] = OBSERVED
    sensors: Mapping[str, object] = field(default_factory=dict)
    randomise: bool | float = False
    masses_t: tuple[float, float] = MASSES_T
    faults: tuple[FaultSpec, ...] = ()

    def __post_init__(self) -> None:
        for key in ("start_strokes", "observed", "masses_t"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        object.__setattr__(self, "faults", faults_of(self.faults, "environment"))
        check_bounds("environment", self, loop_latency=integer(0, MAX_LATENCY), lost_frames=span(0.0, 0.99))
        self.scenario(0)
        if self.duration_s * self.rate_hz > MAX_SAMPLES:
            raise ConfigError(
                f"environment: duration_s = {self.duration_s} at rate_hz = {self.rate_hz} is more than {MAX_SAMPLES} "
                "ticks; choose shorter episodes"
            )
        if not self.observed or len(set(self.observed)) < len(self.observed):
            raise ConfigError(f"environment: observed = {shown(self.observed)}; name each channel once, at least one")
        for name in self.observed:
            self.source(name)
        if self.randomise is not False and self.machine.upper() != "M22":
            raise ConfigError(
                f"environment: randomise draws from the family of M22, and machine = {self.machine!r}; leave one out"
            )
        if self.randomise is not False:
            # For its refusal only.
            member_mass(0, 0, *self.masses_t)
        if not 0.0 < self.spread <= WIDEST:
            raise ConfigError(
                f"environment: randomise = {self.randomise}; a spread is above 0 and at most {typed(WIDEST)}"
            )

    @property
    def spread(self) -> float:
        """Factor on the scatter of the family."""
        return 1.0 if isinstance(self.randomise, bool) else float(self.randomise)

    def scenario(self, seed: int) -> Scenario:
        """Return the scenario of one episode.

        Raises:
            ConfigError: it cannot be.
        """
        return Scenario(
            machine=self.machine,
            duration_s=self.duration_s,
            rate_hz=self.rate_hz,
            step_s=self.step_s,
            sensor_noise=self.sensor_noise,
            seed=seed,
            material=self.material,
            start_strokes=self.start_strokes,
            sensors=self.sensors,
            faults=self.faults,
        )

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Name, unit and kind of each value of an observation."""
        known_channels = {**TABLE_A1, **EXTRA_CHANNELS, **GROUND_CHANNELS}
        return tuple(known_channels[name] for name in self.observed)

    @property
    def columns(self) -> NDArray[np.int64]:
        """Return the source of each observation value, see `edp.sim.episodes.tick.SOURCES`."""
        return np.array([self.source(name) for name in self.observed], dtype=np.int64)

    def source(self, name: str) -> int:
        """Return the source of a channel's value.

        Raises:
            ConfigError: there is no such channel, or only in soil.
        """
        columns = truth_columns(at.LOG_GROUND + at.GROUND_POINTS)
        if name in TABLE_A1:
            return list(TABLE_A1).index(name)
        if name not in columns:
            raise ConfigError(
                f"environment: observed channel '{name}' is unknown{closest(name, [*TABLE_A1, *columns])}"
            )
        if columns[name] >= at.LOG_GROUND and not self.material:
            raise ConfigError(f"environment: observed channel '{name}' is there only in soil; choose a material")
        # Strokes, pump pressures and oil temperature may have faults, so their observation differs from the logged
        # value.
        return shown_names()[name] if name in shown_names() else chain.SENSED + columns[name]


def settings_of(settings: EnvironmentSpec | None, changes: Table) -> EnvironmentSpec:
    """Return the settings (default if None) with the changes applied.

    Raises:
        ConfigError: `settings` is something else, a change names no setting (the closest is offered), or is out of
            range.
    """
    if not isinstance(settings, EnvironmentSpec | None):
        raise ConfigError(
            f"environment: got {shown(settings)} as settings, expected an EnvironmentSpec; give settings by name, such "
            "as machine='M22'"
        )
    names = [entry.name for entry in fields(EnvironmentSpec)]
    for name in changes:
        if name not in names:
            raise ConfigError(f"environment: setting '{name}' is unknown{closest(name, names)}")
    return replace(settings or EnvironmentSpec(), **changes)
