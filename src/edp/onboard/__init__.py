"""On-board adaptation: a small, bounded correction of predictions that is learned while the machine moves."""

from edp.onboard.law import Adaptation, AdaptationSpec
from edp.onboard.reference import Adapter, Learned, Status

__all__ = ["Adaptation", "AdaptationSpec", "Adapter", "Learned", "Status"]
