"""Methods of pretraining: one file and one registration each."""

from edp.training.pretraining.methods.base import PRETRAININGS, Pretraining
from edp.training.pretraining.methods.codes import Codes
from edp.training.pretraining.methods.joint import Joint
from edp.training.pretraining.methods.maml import FirstOrderMaml, Maml
from edp.training.pretraining.methods.reptile import Reptile

__all__ = ["PRETRAININGS", "Codes", "FirstOrderMaml", "Joint", "Maml", "Pretraining", "Reptile"]
