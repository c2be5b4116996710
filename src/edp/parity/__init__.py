"""One golden recording through every form of a network: does each say what PyTorch says, and how fast?"""

import edp.parity.forms  # noqa: F401, enters them
from edp.parity.base import FORMS, Broken, Case, Missing, Ran, Row
from edp.parity.compare import compare, golden_case, recorded_case

__all__ = ["FORMS", "Broken", "Case", "Missing", "Ran", "Row", "compare", "golden_case", "recorded_case"]
