"""Excitation: algorithms that move the levers; one module and one registration per family."""

from edp.sim.excitation import (
    aprbs,
    broadband,
    combined,
    dig,
    end_stops,
    grading,
    isolated,
    reversals,
    six_levers,
    swing_dig,
)
from edp.sim.excitation.base import EXCITATIONS, Excitation

__all__ = [
    "EXCITATIONS",
    "Excitation",
    "aprbs",
    "broadband",
    "combined",
    "dig",
    "end_stops",
    "grading",
    "isolated",
    "reversals",
    "six_levers",
    "swing_dig",
]
