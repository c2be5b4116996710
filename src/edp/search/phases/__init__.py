"""The phases of a search, a file each: coroutines that yield orders, are sent what came of them, and conclude."""

from edp.search.phases import calibration, isolation
from edp.search.phases.base import PHASES, Course, PhaseSpec

__all__ = ["PHASES", "Course", "PhaseSpec", "calibration", "isolation"]
