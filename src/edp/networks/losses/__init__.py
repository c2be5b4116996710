"""Losses on standardised errors (thesis 3.2.2.5, 3.2.4.3): main losses, further terms, and weights; a file each."""

from edp.networks.losses.base import LOSSES, LossSpec, Penalty, Prediction, masked_loss
from edp.networks.losses.correlation import Correlation
from edp.networks.losses.derivative import Derivative
from edp.networks.losses.drift import Drift
from edp.networks.losses.focal import Focal
from edp.networks.losses.heteroscedastic import Heteroscedastic
from edp.networks.losses.huber import Huber
from edp.networks.losses.mse import MeanSquared
from edp.networks.losses.quantile import Quantile
from edp.networks.losses.smoothness import Smoothness
from edp.networks.losses.terms import TERMS, Course, TermSpec
from edp.networks.losses.weights import AdaptiveWeights, horizon_weights, output_weights

__all__ = [
    "LOSSES",
    "TERMS",
    "AdaptiveWeights",
    "Correlation",
    "Course",
    "Derivative",
    "Drift",
    "Focal",
    "Heteroscedastic",
    "Huber",
    "LossSpec",
    "MeanSquared",
    "Penalty",
    "Prediction",
    "Quantile",
    "Smoothness",
    "TermSpec",
    "horizon_weights",
    "masked_loss",
    "output_weights",
]
