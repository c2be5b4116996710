"""Methods of transfer: one file and one registration each."""

from edp.workflows.transfer.methods.base import METHODS, Made, Method
from edp.workflows.transfer.methods.code import MachineCodeAlone, code_names
from edp.workflows.transfer.methods.direct import Direct
from edp.workflows.transfer.methods.few_steps import FewSteps
from edp.workflows.transfer.methods.full import Full
from edp.workflows.transfer.methods.linear_probe import LinearProbe
from edp.workflows.transfer.methods.low_rank import Adapters
from edp.workflows.transfer.methods.rehearsal import Adversarial, DistilledRehearsal, Rehearsal
from edp.workflows.transfer.methods.ridge_arx import Ridge
from edp.workflows.transfer.methods.scratch import Scratch
from edp.workflows.transfer.methods.two_phase import TwoPhase

__all__ = [
    "METHODS",
    "Adapters",
    "Adversarial",
    "Direct",
    "DistilledRehearsal",
    "FewSteps",
    "Full",
    "LinearProbe",
    "MachineCodeAlone",
    "Made",
    "Method",
    "Rehearsal",
    "Ridge",
    "Scratch",
    "TwoPhase",
    "code_names",
]
