"""From a network of one machine and minutes of logs of another to a network of the other (thesis 3.4)."""

from edp.training.transfer.spec import FinetuneSpec
from edp.workflows.transfer.finetune import FinetuneRequest, finetune
from edp.workflows.transfer.methods import METHODS

__all__ = ["METHODS", "FinetuneRequest", "FinetuneSpec", "finetune"]
