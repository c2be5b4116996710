"""Settings of a monitor: conversion from TOML to validated objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from edp.errors import ConfigError
from edp.monitor.detectors import DETECTORS
from edp.monitor.fitting import ChainSpec
from edp.monitor.residuals import RESIDUALS, ResidualSpec
from edp.monitor.residuals.balances import BalancesSpec
from edp.monitor.residuals.committees import CommitteeOptions
from edp.monitor.residuals.flow_balances import FlowBalancesSpec
from edp.monitor.residuals.look_ahead import LookAheadSpec
from edp.monitor.residuals.virtual_sensors import VirtualSensorsSpec
from edp.settings.bounds import MAX_NAMES, MIN_MINUTES, SEED, above, between, check_bounds, check_count, integer, span
from edp.settings.tree import SettingsTree

MONITOR_SETTINGS = SettingsTree({"residuals": RESIDUALS, "detector": DETECTORS}, what="settings")


def trains_networks(experiment: MonitorExperiment) -> bool:
    """Return whether settings have residuals that train networks, whose time `MonitorExperiment.minutes` bounds."""
    return any(isinstance(part, CommitteeOptions) for part in experiment.residuals)


def default_residuals() -> tuple[ResidualSpec, ...]:
    """Return residual sources that need no settings; unsuitable ones are skipped when fitting."""
    return VirtualSensorsSpec(), LookAheadSpec(), BalancesSpec(), FlowBalancesSpec()


AUTOMATIC, NO_MACHINE = "", "none"


@dataclass(frozen=True, kw_only=True)
class DictionarySpec:
    """Settings for simulating the fault dictionary, from which causes of alarms are named.

    Attributes:
        machine: name or file of the machine that is simulated; empty takes the one that the logs name, ``none`` makes
            no dictionary.
        draws: sessions of each fault and size; two at least, so that some are left out.
        before_s: length of a session before its fault, s.
        after_s: length of a session after the onset, s.
        time_budget_min: processor time, min. A draw that would exceed it is not started, except for the first two.
        kinds: kinds of faults; empty for all.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    machine: str = AUTOMATIC
    draws: int = 3
    before_s: float = 8.0
    after_s: float = 60.0
    time_budget_min: float = 15.0
    kinds: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_bounds(
            "dictionary",
            self,
            draws=integer(2, 100),
            before_s=span(0.0, 3600.0),
            after_s=span(20.0, 3600.0),
            time_budget_min=span(MIN_MINUTES, 1e5),
        )
        check_count("dictionary", "kinds", self.kinds, MAX_NAMES)


@dataclass(frozen=True, kw_only=True)
class MonitorExperiment:
    """Everything that settles a monitor.

    Attributes:
        residuals: sources, each a registered part.
        chain: settings from residuals to alarms.
        dictionary: settings of the dictionary of faults, which names causes.
        channels: names of the channels that are watched; empty takes all that sensors can give.
        groups: names of channels that virtual sensors judge together; empty where names and kinds are to tell.
        hours_per_false_alarm: operating hours to one false alarm that are promised.
        train_fraction: share of the healthy sessions that residuals are fitted to; the others set conditioning and
            limit.
        time_budget_min: processor time that fits of networks may take, about.
        seed: root of every random choice.

    Raises:
        ConfigError: a value is out of its bounds, or nothing would be watched.
    """

    residuals: tuple[ResidualSpec, ...] = field(default_factory=default_residuals)
    chain: ChainSpec = field(default_factory=ChainSpec)
    dictionary: DictionarySpec = field(default_factory=DictionarySpec)
    channels: tuple[str, ...] = ()
    groups: tuple[tuple[str, ...], ...] = ()
    hours_per_false_alarm: float = 8.0
    train_fraction: float = 0.35
    time_budget_min: float = 5.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(
            "monitor",
            self,
            hours_per_false_alarm=above(0.0, 1e6),
            train_fraction=between(0.0, 1.0),
            time_budget_min=span(MIN_MINUTES, 1e5),
            seed=SEED,
        )
        check_count("monitor", "channels", self.channels, MAX_NAMES)
        check_count("monitor", "groups", self.groups, MAX_NAMES)
        check_count("monitor", "residuals", self.residuals, 16, least=1)
        kinds = [RESIDUALS.name_of(part) for part in self.residuals]
        if len(set(kinds)) < len(kinds):
            raise ConfigError(f"monitor: residuals = {kinds}; name each source once")


def load_monitor_experiment(
    path: str | Path | None = None, overrides: Sequence[str] = (), options: Mapping[str, object] | None = None
) -> MonitorExperiment:
    """Load settings from a TOML file, changed by command options and ``key.path=value`` overrides.

    Args:
        path: settings file.
        overrides: each ``key.path=value``; they go before options.
        options: plain values of options that were given, by key.

    Raises:
        ConfigError: names every unknown key, wrong type and impossible value at once.
    """
    return MONITOR_SETTINGS.load(MonitorExperiment, path, overrides, "of a monitor", options)


def monitor_toml(experiment: MonitorExperiment) -> str:
    """Return the complete settings as TOML, including defaults, for the monitor's folder."""
    return tomli_w.dumps(MONITOR_SETTINGS.to_dict(experiment))
