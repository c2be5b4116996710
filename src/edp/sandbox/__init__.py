"""Sandboxed processes that read one log each, so that a hostile file can only harm its own reader."""

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
