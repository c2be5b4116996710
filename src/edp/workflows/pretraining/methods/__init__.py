"""Methods of pretraining: one file and one registration each."""

from edp.workflows.pretraining.methods.base import PRETRAININGS, Pretraining
from edp.workflows.pretraining.methods.codes import Codes
from edp.workflows.pretraining.methods.joint import Joint
from edp.workflows.pretraining.methods.maml import FirstOrderMaml, Maml
from edp.workflows.pretraining.methods.reptile import Reptile

__all__ = ["PRETRAININGS", "Codes", "FirstOrderMaml", "Joint", "Maml", "Pretraining", "Reptile"]
