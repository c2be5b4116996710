"""Gymnasium, which only this package and `edp.control` need."""

from __future__ import annotations

from edp.errors import ConfigError

try:
    import gymnasium
except ImportError as error:
    raise ConfigError(
        "environments need the package gymnasium, which is not installed; run pip install "
        "'excavator-dynamics-predictor[control]'"
    ) from error

__all__ = ["gymnasium"]
