"""What users run, end to end: trainings, searches, compression, transfer, pre-training, adaptation, parity."""

from edp.registry import load_plugins as load_plugins
