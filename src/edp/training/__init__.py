"""Training: the loop, its parts, checkpoints and bundles."""

from edp.training.bundle import Bundle, load_bundle, make_bundle, save_bundle
from edp.training.fit import Event, Fitted, TrainingSpec, fit

__all__ = ["Bundle", "Event", "Fitted", "TrainingSpec", "fit", "load_bundle", "make_bundle", "save_bundle"]
