"""Screening of channels: which to feed a model, with how much memory, and which to leave out and why."""

from edp.screening.result import (
    Choice,
    Cluster,
    Flag,
    FlagKind,
    Importance,
    LagCurve,
    LagRange,
    Matrices,
    OnProgress,
    Proposal,
    Screening,
    Stability,
    Value,
)
from edp.screening.screen import screen
from edp.screening.spec import ForestSpec, ScreeningSpec

__all__ = [
    "Choice",
    "Cluster",
    "Flag",
    "FlagKind",
    "ForestSpec",
    "Importance",
    "LagCurve",
    "LagRange",
    "Matrices",
    "OnProgress",
    "Proposal",
    "Screening",
    "ScreeningSpec",
    "Stability",
    "Value",
    "screen",
]
