"""What a number format says of a network, and a network in one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.evaluation.controller import Budget, Estimate, ResourceUsage
from edp.evaluation.footprint import footprint
from edp.networks.predictor import Predictor
from edp.registry import Registry

Predict = Callable[[Sequence[Series]], list[NDArray[np.float32]]]
"""Predictions ``(time, horizon, target)`` in SI units for each series, as the format computes them."""


class Format(Protocol):
    """A number format.

    Attributes:
        label: how tables call it.
        estimated: name in `edp.evaluation.controller.FORMATS` of the estimate of its cycles, program and state.
        rounded: whether training with rounded numbers is of use for it.
    """

    label: ClassVar[str]
    estimated: ClassVar[str]
    rounded: ClassVar[bool]

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """Memory for the parameters of a network, whose C code takes `estimate`."""
        ...

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """How the network predicts in this format; `training_series` are training series, to find ranges on."""
        ...


FORMATS: Registry[type[Format]] = Registry("number format")


def resource_usage(
    predictor: Predictor, name: str, budget: Budget, parameter_bytes: int | None = None
) -> ResourceUsage:
    """What a network takes in the format `name` on the core of a budget.

    Args:
        predictor: the network; its weights need not be trained.
        name: a name of `FORMATS`.
        budget: says which core.
        parameter_bytes: where they are known better than the format knows them.

    Raises:
        ExportError: the network has no form in this format.
    """
    form, counts = FORMATS[name](), footprint(predictor)
    estimate = counts.estimate(form.estimated)
    weights = form.parameter_bytes(predictor, estimate) if parameter_bytes is None else parameter_bytes
    return ResourceUsage(
        parameters=counts.parameters_folded,
        macs_tick=counts.macs_tick,
        macs_window=counts.macs_window,
        cycles=estimate.cycles[budget.core],
        parameter_bytes=weights,
        ram_bytes=weights + estimate.ram_bytes,
        # Constants lie in flash, too; they are counted in both, as in the thesis.
        flash_bytes=weights + estimate.program_bytes,
    )


@dataclass(frozen=True, eq=False)
class Deployed:
    """A network in a number format.

    Attributes:
        number_format: a name of `FORMATS`.
        predict: how it predicts.
        resource_usage: what it takes.
    """

    number_format: str
    predict: Predict
    resource_usage: ResourceUsage


def deploy(
    predictor: Predictor,
    name: str,
    training_series: Sequence[Series],
    budget: Budget,
    parameter_bytes: int | None = None,
) -> Deployed:
    """A network in the format `name`.

    Args:
        predictor: the network, in float32.
        name: a name of `FORMATS`.
        training_series: training series, on which ranges of activations are found.
        budget: says for which core cycles are estimated.
        parameter_bytes: where they are known better than the format knows them.

    Raises:
        ConfigError: an unknown format, or a network that it cannot hold.
    """
    predict = FORMATS[name]().predictions(predictor, training_series)
    return Deployed(name, predict, resource_usage(predictor, name, budget, parameter_bytes))
