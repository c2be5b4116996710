"""One golden recording through every form of a network: does each say what PyTorch says, and how fast?"""

import edp.parity.forms  # noqa: F401, enters them
from edp.parity.base import FORMS, Broken, Case, Missing, Ran, Row
from edp.parity.compare import compare, golden_case, recorded_case
from edp.parity.consent import WHAT, from_own_run

__all__ = [
    "FORMS",
    "WHAT",
    "Broken",
    "Case",
    "Missing",
    "Ran",
    "Row",
    "compare",
    "from_own_run",
    "golden_case",
    "recorded_case",
]
