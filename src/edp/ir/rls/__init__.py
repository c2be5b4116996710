"""On-board adaptation: a small, bounded correction of predictions that is learned while the machine moves."""

from edp.ir.rls.constants import Adaptation, AdaptationSpec
from edp.ir.rls.reference import RlsCorrector, RlsState, RlsStatus

__all__ = ["Adaptation", "AdaptationSpec", "RlsCorrector", "RlsState", "RlsStatus"]
