"""The temperature of the oil in a recording, where it is measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edp.recording import Recording
from edp.signals import Kind

OIL = "OilTemperature"
"""Name of the oil temperature channel, of kind temperature."""
FREEZING_K = 273.15


def oil_celsius(recording: Recording) -> NDArray[np.float64]:
    """Return the oil temperature at each sample ``(time,)``, degC; NaN if the recording has no such channel."""
    if OIL not in recording.channel_names or recording.channels[recording.index(OIL)].kind is not Kind.TEMPERATURE:
        return np.full(recording.samples, np.nan)
    return recording.column(OIL).astype(np.float64) - FREEZING_K
