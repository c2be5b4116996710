"""Detectors of a change in residuals: one file each, entered in `DETECTORS` by name."""

from edp.monitor.detectors.base import DETECTORS, Alarm, Detector, DetectorSpec, alarms, statistics
from edp.monitor.detectors.cusum import CusumSpec as CusumSpec
from edp.monitor.detectors.e_detector import EDetectorSpec as EDetectorSpec
from edp.monitor.detectors.ewma import EwmaSpec as EwmaSpec
from edp.monitor.detectors.glr import GlrSpec as GlrSpec
from edp.monitor.detectors.separate_cusums import SeparateCusumsSpec as SeparateCusumsSpec

__all__ = ["DETECTORS", "Alarm", "Detector", "DetectorSpec", "alarms", "statistics"]
