"""Training: the loop, its parts, checkpoints and bundles."""

from edp.training.bundle import Bundle, load_bundle, make_bundle, save_bundle, upgrade_bundle
from edp.training.fit import TrainingSpec, fit
from edp.training.outcome import Diverged, Fitted, TrainingProgress

__all__ = [
    "Bundle",
    "Diverged",
    "Fitted",
    "TrainingProgress",
    "TrainingSpec",
    "fit",
    "load_bundle",
    "make_bundle",
    "save_bundle",
    "upgrade_bundle",
]
