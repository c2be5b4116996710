"""Sources of a live session: a file each."""

from edp.workflows.live.sources import log as log
from edp.workflows.live.sources import loop as loop
from edp.workflows.live.sources import ros2 as ros2
from edp.workflows.live.sources import sim as sim
from edp.workflows.live.sources import udp as udp
from edp.workflows.live.sources.base import (
    SOURCES,
    LiveSource,
    Needs,
    Sink,
    SourceOptions,
    SourceStopped,
    check_options,
)

__all__ = ["SOURCES", "LiveSource", "Needs", "Sink", "SourceOptions", "SourceStopped", "check_options"]
