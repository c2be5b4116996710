"""Models available to controllers: a static valve map, and models trained on recordings of the plant."""

from __future__ import annotations

from dataclasses import dataclass

from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.networks.twin import Twin
from edp.training.bundle import Bundle


@dataclass(frozen=True, eq=False)
class ControlModels:
    """Models for controllers; missing models are None.

    Attributes:
        valve_map: cylinder speed by lever, measured on the plant or on a twin of it.
        twin: a plant model that runs on commands alone.
        predictor: a look-ahead predictor.
    """

    valve_map: ValveMap | None = None
    twin: Twin | None = None
    predictor: Bundle | None = None

    def require_map(self, who: str) -> ValveMap:
        """Return the valve map.

        Raises:
            ConfigError: there is none; `who` needs it.
        """
        if self.valve_map is None:
            raise ConfigError(f"controller '{who}' needs a valve map; measure one with measure_valve_map")
        return self.valve_map

    def require_twin(self, who: str) -> Twin:
        """Return the twin.

        Raises:
            ConfigError: there is none; `who` needs it.
        """
        if self.twin is None:
            raise ConfigError(
                f"controller '{who}' needs a twin; train one with edp twin and name its run folder with --twin"
            )
        return self.twin
