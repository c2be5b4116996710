"""Jobs of users from start to end: training, search, compression, transfer, pre-training, adaptation, parity."""

from edp.registry import load_plugins as load_plugins
