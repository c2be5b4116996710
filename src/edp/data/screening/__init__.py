"""Screening of channels: which to feed a model, with how much memory, and which to leave out and why."""

from edp.data.screening.result import (
    ChannelVerdict,
    Cluster,
    Flag,
    FlagKind,
    GroupImportance,
    LagCurve,
    LagRange,
    Matrices,
    OnProgress,
    Proposal,
    ScreeningResult,
    Stability,
    Value,
)
from edp.data.screening.screen import screen
from edp.data.screening.spec import ForestSpec, ScreeningSpec

__all__ = [
    "ChannelVerdict",
    "Cluster",
    "Flag",
    "FlagKind",
    "ForestSpec",
    "GroupImportance",
    "LagCurve",
    "LagRange",
    "Matrices",
    "OnProgress",
    "Proposal",
    "ScreeningResult",
    "ScreeningSpec",
    "Stability",
    "Value",
    "screen",
]
