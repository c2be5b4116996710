"""Number formats in which a smaller network can run: one file and one registration each."""

from edp.workflows.compression.formats import dynamic_int8, float32, w8a16
from edp.workflows.compression.formats.base import (
    FORMATS,
    Deployed,
    Format,
    Predict,
    deploy,
    resource_usage,
)

__all__ = [
    "FORMATS",
    "Deployed",
    "Format",
    "Predict",
    "deploy",
    "dynamic_int8",
    "float32",
    "resource_usage",
    "w8a16",
]
