"""A machine live: sources, models beside them, and a page in the browser."""

from edp.workflows.live.run_live import LiveOrder, LiveResult, LiveRun, run_live
from edp.workflows.live.sources import SOURCES, SourceOptions

__all__ = ["SOURCES", "LiveOrder", "LiveResult", "LiveRun", "SourceOptions", "run_live"]
