"""Losses on standardised errors (thesis 3.2.2.5, 3.2.4.3): main losses, additional terms, weights; a module each."""

from edp.networks.losses.base import LOSSES, LossSpec, Penalty, Prediction, compute_masked_loss
from edp.networks.losses.correlation import Correlation as Correlation
from edp.networks.losses.derivative import Derivative as Derivative
from edp.networks.losses.drift import Drift as Drift
from edp.networks.losses.focal import Focal as Focal
from edp.networks.losses.heteroscedastic import Heteroscedastic as Heteroscedastic
from edp.networks.losses.huber import Huber as Huber
from edp.networks.losses.mse import MeanSquared as MeanSquared
from edp.networks.losses.quantile import Quantile as Quantile
from edp.networks.losses.smoothness import Smoothness as Smoothness
from edp.networks.losses.terms import TERMS, Course, TermSpec
from edp.networks.losses.weights import AdaptiveWeights, horizon_weights, output_weights

__all__ = [
    "LOSSES",
    "TERMS",
    "AdaptiveWeights",
    "Course",
    "LossSpec",
    "Penalty",
    "Prediction",
    "TermSpec",
    "compute_masked_loss",
    "horizon_weights",
    "output_weights",
]
