"""Methods of transfer: one file and one registration each."""

from edp.transfer.methods.base import METHODS, Made, Method
from edp.transfer.methods.direct import Direct
from edp.transfer.methods.few_steps import FewSteps
from edp.transfer.methods.full import Full
from edp.transfer.methods.linear_probe import LinearProbe
from edp.transfer.methods.low_rank import Adapters
from edp.transfer.methods.replay import Adversarial, Replay, ReplayDistilled
from edp.transfer.methods.ridge_arx import Ridge
from edp.transfer.methods.scratch import Scratch
from edp.transfer.methods.two_phase import TwoPhase

__all__ = [
    "METHODS",
    "Adapters",
    "Adversarial",
    "Direct",
    "FewSteps",
    "Full",
    "LinearProbe",
    "Made",
    "Method",
    "Replay",
    "ReplayDistilled",
    "Ridge",
    "Scratch",
    "TwoPhase",
]
