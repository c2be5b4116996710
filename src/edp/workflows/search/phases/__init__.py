"""The phases of a search, a file each: coroutines that yield orders, are sent what came of them, and conclude.

The order of the imports is the order in which they run.
"""

from edp.workflows.search.phases import isolation  # isort: skip
from edp.workflows.search.phases import calibration  # isort: skip
from edp.workflows.search.phases import screening  # isort: skip
from edp.workflows.search.phases import planning  # isort: skip
from edp.workflows.search.phases import confirmation  # isort: skip
from edp.workflows.search.phases import synthesis  # isort: skip
from edp.workflows.search.phases import exploration  # isort: skip
from edp.workflows.search.phases import compression  # isort: skip
from edp.workflows.search.phases.base import PHASES, Course, PhaseSpec

__all__ = [
    "PHASES",
    "Course",
    "PhaseSpec",
    "calibration",
    "compression",
    "confirmation",
    "exploration",
    "isolation",
    "planning",
    "screening",
    "synthesis",
]
