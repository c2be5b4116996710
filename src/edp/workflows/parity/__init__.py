"""Test of all forms of a network on one golden recording: values against PyTorch, and speed."""

import edp.workflows.parity.forms  # noqa: F401, enters them
from edp.workflows.parity.base import FORMS, Broken, Missing, ParityCase, Ran, Row
from edp.workflows.parity.compare import compare, golden_case, record_case
from edp.workflows.parity.consent import WHAT, from_own_run

__all__ = [
    "FORMS",
    "WHAT",
    "Broken",
    "Missing",
    "ParityCase",
    "Ran",
    "Row",
    "compare",
    "from_own_run",
    "golden_case",
    "record_case",
]
