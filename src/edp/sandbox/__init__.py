"""Processes that read one log each and may do nothing else: what a hostile file does to its library stays there."""

from edp.sandbox.lockdown import lock_down
from edp.sandbox.sandbox import Channel, end, open_channel, watch

__all__ = ["Channel", "end", "lock_down", "open_channel", "watch"]
