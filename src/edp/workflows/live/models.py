"""Models of a run folder for a live session, and the channels that they read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from edp.errors import ConfigError
from edp.monitor.monitor_file import load_monitor
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle, load_bundle
from edp.training.twin_bundle import TwinBundle, holds_twin, load_twin
from edp.wording import typed
from edp.workflows.live.sources import LiveSource, Needs

MAX_LEVERS = 12
LEVER = "Lever_"


@dataclass(frozen=True)
class LiveModels:
    """Models of a run folder."""

    bundle: Bundle | None = None
    twin: TwinBundle | None = None
    channels: tuple[Channel, ...] = field(default=())
    rate_hz: float | None = None


def models_of(run: Path | None) -> LiveModels:
    """Return the network or twin of a run folder.

    Raises:
        EdpError: it holds none.
    """
    if run is None:
        return LiveModels()
    if holds_twin(run):
        twin = load_twin(run)
        channels = twin.twin.channels
        return LiveModels(twin=twin, channels=(*channels.commands, *channels.answers), rate_hz=channels.rate_hz)
    bundle = load_bundle(run)
    targets = [
        Channel(name, kind, text)
        for name, kind, text in zip(bundle.task.targets, bundle.target_kinds, bundle.descriptions, strict=True)
        if name not in bundle.task.inputs
    ]
    return LiveModels(bundle=bundle, channels=(*bundle.inputs, *targets), rate_hz=bundle.task.rate_hz)


def needs_of(models: LiveModels, monitor_folder: Path | None) -> Needs:
    """Return the channels and the rate that models and monitor require of a source."""
    channels = list(models.channels)
    rate = models.rate_hz
    if monitor_folder is not None:
        monitor = load_monitor(monitor_folder)
        channels += [channel for channel in monitor.channels if channel not in channels]
        rate = rate or monitor.rate_hz
    return Needs(channels, rate, None if models.twin is None else models.twin.twin.channels)


def check_rate(source: LiveSource, models: LiveModels) -> None:
    """Refuse a source whose rate differs from the models'.

    Raises:
        ConfigError: the rates differ.
    """
    rate = models.rate_hz
    # A thousandth: loggers state the same rate with different digits.
    if rate is not None and abs(source.rate_hz - rate) > 1e-3 * rate:
        raise ConfigError(
            f"{source.text} has {typed(source.rate_hz)} Hz, the run {typed(rate)} Hz; set rate_hz in the signal "
            "map, or choose "
            "a run of this rate"
        )


def levers_of(channels: tuple[Channel, ...], twin: TwinBundle | None) -> list[int]:
    """Return the columns of commands: levers, else the twin's commands, else pilot pressures without conflux ones."""
    commanded = {c.name for c in twin.twin.channels.commands} if twin is not None else set()
    pilots = [c.name for c in channels if c.kind is Kind.PILOT_PRESSURE and not c.name.endswith("Conf")]
    levers = [c.name for c in channels if c.name.startswith(LEVER)]
    chosen = levers or [c.name for c in channels if c.name in commanded] or pilots
    return [n for n, channel in enumerate(channels) if channel.name in chosen][:MAX_LEVERS]
