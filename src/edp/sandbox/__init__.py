"""Processes that read one log each and may do nothing else: what a hostile file does to its library stays there."""

from edp.sandbox.layers import SandboxWarning, require_layers
from edp.sandbox.lockdown import lock_down
from edp.sandbox.sandbox import WorkerConnection, end, open_channel, watch

__all__ = [
    "SandboxWarning",
    "WorkerConnection",
    "end",
    "lock_down",
    "open_channel",
    "require_layers",
    "watch",
]
