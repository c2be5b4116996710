"""Live view: source and model data, sample by sample, on a page of a small local server."""

from edp.live.layout import Forecast, LiveLayout, LiveTrace
from edp.live.pace import Pace
from edp.live.saved import write_session_page
from edp.live.session import LiveSession

__all__ = ["Forecast", "LiveLayout", "LiveSession", "LiveTrace", "Pace", "write_session_page"]
