"""Live view of a machine: sources, models, and a page in the browser."""

from edp.workflows.live.run_live import LiveOrder, LiveResult, LiveRun
from edp.workflows.live.serve_live import run_live
from edp.workflows.live.sources import SOURCES, SourceOptions, check_options

__all__ = ["SOURCES", "LiveOrder", "LiveResult", "LiveRun", "SourceOptions", "check_options", "run_live"]
