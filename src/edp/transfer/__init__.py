"""From a network of one machine and minutes of logs of another to a network of the other (thesis 3.4)."""

from edp.transfer.finetune import Order, Watchers, finetune
from edp.transfer.methods import METHODS
from edp.transfer.spec import FinetuneSpec

__all__ = ["METHODS", "FinetuneSpec", "Order", "Watchers", "finetune"]
