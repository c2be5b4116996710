"""One network over many machines: joint training and meta-learning, judged on machines that were never seen."""

from edp.pretraining.methods import PRETRAININGS, Pretraining
from edp.pretraining.pretrain import Pretrain, pretrain
from edp.pretraining.spec import MetaSpec

__all__ = ["PRETRAININGS", "MetaSpec", "Pretrain", "Pretraining", "pretrain"]
