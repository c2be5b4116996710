"""Screening of channels: selection of model inputs and memory length, with reasons for every omitted channel."""

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
