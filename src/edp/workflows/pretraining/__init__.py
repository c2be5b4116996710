"""One network for many machines: joint training and meta-learning, evaluated on unseen machines."""

from edp.training.pretraining.methods import PRETRAININGS, Pretraining
from edp.training.pretraining.spec import MetaSpec
from edp.workflows.pretraining.pretrain import Pretrain, pretrain

__all__ = ["PRETRAININGS", "MetaSpec", "Pretrain", "Pretraining", "pretrain"]
