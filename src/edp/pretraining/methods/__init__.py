"""Methods of pretraining: one file and one registration each."""

from edp.pretraining.methods.base import PRETRAININGS, Pretraining
from edp.pretraining.methods.joint import Joint
from edp.pretraining.methods.maml import FirstOrderMaml, Maml
from edp.pretraining.methods.reptile import Reptile

__all__ = ["PRETRAININGS", "FirstOrderMaml", "Joint", "Maml", "Pretraining", "Reptile"]
