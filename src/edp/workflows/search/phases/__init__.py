"""Phases of a search, one per file: coroutines that yield requests, receive outcomes, and conclude.

The order of the imports is the order in which they run.
"""

from edp.workflows.search.phases import isolation as isolation  # isort: skip
from edp.workflows.search.phases import calibration as calibration  # isort: skip
from edp.workflows.search.phases import screening as screening  # isort: skip
from edp.workflows.search.phases import planning as planning  # isort: skip
from edp.workflows.search.phases import confirmation as confirmation  # isort: skip
from edp.workflows.search.phases import synthesis as synthesis  # isort: skip
from edp.workflows.search.phases import exploration as exploration  # isort: skip
from edp.workflows.search.phases import compression as compression  # isort: skip
from edp.workflows.search.phases.base import PHASES, Course, PhaseSpec

__all__ = [
    "PHASES",
    "Course",
    "PhaseSpec",
]
