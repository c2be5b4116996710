"""Mean squared error."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from edp.networks.losses.base import LOSSES, Penalty


@LOSSES.register("mse")
@dataclass(frozen=True, kw_only=True)
class MeanSquared(Penalty):
    """Squared error (eq. 3.29)."""

    def penalty(self, error: Tensor) -> Tensor:
        """Return ``e^2``."""
        return error.square()
