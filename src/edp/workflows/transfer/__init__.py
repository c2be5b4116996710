"""From a network of one machine and minutes of logs of another to a network of the other (thesis 3.4)."""

from edp.workflows.transfer.finetune import FinetuneCallbacks, FinetuneRequest, finetune
from edp.workflows.transfer.methods import METHODS
from edp.workflows.transfer.spec import FinetuneSpec

__all__ = ["METHODS", "FinetuneCallbacks", "FinetuneRequest", "FinetuneSpec", "finetune"]
