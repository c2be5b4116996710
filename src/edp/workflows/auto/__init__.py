"""Automatic preset: several models are trained and evaluated on left-out data; the simplest of the best is kept."""

from edp.workflows.auto.settings import AutoSettings, auto_settings, load_auto, usual_preset
from edp.workflows.auto.train_auto import AutoResult, train_auto

__all__ = ["AutoResult", "AutoSettings", "auto_settings", "load_auto", "train_auto", "usual_preset"]
