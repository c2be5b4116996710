"""Excavator Dynamics Predictor: recordings in, a judged and deployable plant model out."""

__version__ = "0.1.0"
