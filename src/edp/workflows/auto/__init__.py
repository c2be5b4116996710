"""Automatic preset: train several models, evaluate them on left-out data and select the simplest of the best."""

from edp.workflows.auto.settings import AutoSettings, auto_settings, load_auto, usual_preset
from edp.workflows.auto.train_auto import AutoResult, train_auto

__all__ = ["AutoResult", "AutoSettings", "auto_settings", "load_auto", "train_auto", "usual_preset"]
