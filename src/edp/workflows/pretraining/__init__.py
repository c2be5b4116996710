"""One network over many machines: joint training and meta-learning, judged on machines that were never seen."""

from edp.workflows.pretraining.methods import PRETRAININGS, Pretraining
from edp.workflows.pretraining.pretrain import Pretrain, pretrain
from edp.workflows.pretraining.spec import MetaSpec

__all__ = ["PRETRAININGS", "MetaSpec", "Pretrain", "Pretraining", "pretrain"]
