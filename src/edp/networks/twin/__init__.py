"""Plant models for free-run simulation: commands to velocities, strokes and pressures, with feedback ports."""

from edp.networks.twin import (  # noqa: F401  registers the formulations
    arx,
    elements,
    greybox,
    n4sid,
    recurrent,
    residual,
    static_map,
)
from edp.networks.twin.base import TWINS, Twin, TwinSpec, TwinState, even_starts, starts_within
from edp.networks.twin.grey import ground_drag  # noqa: F401  registers the grounds
from edp.networks.twin.intervals import FreeRunIntervals, calibrate
from edp.networks.twin.plant import IntegerTwinPlant, TwinPlant
from edp.networks.twin.scales import TwinScales, fit_scales

__all__ = [
    "TWINS",
    "FreeRunIntervals",
    "IntegerTwinPlant",
    "Twin",
    "TwinPlant",
    "TwinScales",
    "TwinSpec",
    "TwinState",
    "calibrate",
    "even_starts",
    "fit_scales",
    "starts_within",
]
