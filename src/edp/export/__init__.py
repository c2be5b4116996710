"""Writes a trained network in a form that runs without EDP: one file or folder a target, entered in `TARGETS`."""

from edp.export.base import TARGETS, ExportTarget
from edp.export.c import CTarget

__all__ = ["TARGETS", "CTarget", "ExportTarget"]
