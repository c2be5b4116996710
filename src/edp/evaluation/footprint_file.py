"""Content of ``footprint.json``: cost of a network, and its comparison with a controller's budget."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from edp.evaluation.controller import Budget, LimitCheck
from edp.settings.results import ResultFile


@dataclass(frozen=True)
class PartCost:
    """Parameters of a part of a network, and its multiply-accumulates per sample of a stream and per window."""

    part: str
    parameters: int
    macs_tick: int
    macs_window: int


@dataclass(frozen=True, kw_only=True)
class StatedEstimate:
    """Estimate of one number format, see `edp.evaluation.controller.Estimate`; None for a figure that is not stated."""

    number_format: str
    cycles: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)
    parameter_bytes: int | None = None
    program_bytes: int | None = None
    ram_bytes: int | None = None
    flash_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class FootprintFile(ResultFile):
    """Content of ``footprint.json``, see `edp.evaluation.footprint.Footprint`; None for a figure that is not stated.

    Attributes:
        budget: limits of the controller that the network is compared with; None without one.
        verdict: comparison with each limit.
    """

    NAME = "footprint.json"
    WHAT = "footprint"
    ADVICE = "remove it and run edp evaluate"

    parameters: int | None = None
    parameters_folded: int | None = None
    macs_window: int | None = None
    macs_tick: int | None = None
    peak_activation_bytes: int | None = None
    peak_activation_bytes_window: int | None = None
    state_bytes: int | None = None
    window: int | None = None
    rows: tuple[PartCost, ...] = ()
    estimates: tuple[StatedEstimate, ...] = ()
    refused: Mapping[str, str] = field(default_factory=dict)
    budget: Budget | None = None
    verdict: tuple[LimitCheck, ...] = ()

    @property
    def stated_budget(self) -> Budget | None:
        """Budget that a user stated; None for the default, with which earlier versions compared every run."""
        return None if self.budget == Budget() else self.budget

    @property
    def checks(self) -> tuple[LimitCheck, ...]:
        """Comparison with each limit of the stated budget; empty without one."""
        return self.verdict if self.stated_budget else ()
