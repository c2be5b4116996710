"""Losses on standardised errors (thesis 3.2.2.5, 3.2.4.3): main losses, further terms, and weights; a file each."""

from edp.losses.base import LOSSES, Answer, LossSpec, Penalty, masked_loss
from edp.losses.correlation import Correlation
from edp.losses.derivative import Derivative
from edp.losses.drift import Drift
from edp.losses.focal import Focal
from edp.losses.heteroscedastic import Heteroscedastic
from edp.losses.huber import Huber
from edp.losses.mse import MeanSquared
from edp.losses.quantile import Quantile
from edp.losses.smoothness import Smoothness
from edp.losses.terms import TERMS, Course, TermSpec
from edp.losses.weights import AdaptiveWeights, horizon_weights, output_weights

__all__ = [
    "LOSSES",
    "TERMS",
    "AdaptiveWeights",
    "Answer",
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
    "Quantile",
    "Smoothness",
    "TermSpec",
    "horizon_weights",
    "masked_loss",
    "output_weights",
]
