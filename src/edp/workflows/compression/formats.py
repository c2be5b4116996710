"""Number formats of a smaller network, and its memory and time on a controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.evaluation.controller import Budget, Estimate, ResourceUsage
from edp.evaluation.footprint import footprint
from edp.networks.integer import integer_predictor
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.registry import Registry
from edp.training.compression.int8 import dynamic_int8

Predict = Callable[[Sequence[Series]], list[NDArray[np.float32]]]
"""Predictions ``(time, horizon, target)`` in SI units for each series, as the format computes them."""


class Format(Protocol):
    """A number format.

    Attributes:
        label: name in tables.
        estimated: name in `edp.evaluation.controller.FORMATS` of the estimate of its cycles, program and state.
        rounded: whether training with rounded weights is of use for it.
    """

    label: ClassVar[str]
    estimated: ClassVar[str]
    rounded: ClassVar[bool]

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """Return the memory for the parameters of a network, whose C code takes `estimate`."""
        ...

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """Return the network's prediction function in this format; `training_series` give the ranges."""
        ...


FORMATS: Registry[type[Format]] = Registry("number format")


@FORMATS.register("dynamic_int8")
class DynamicInt8:
    """Linear layers with 8-bit weights and inputs rounded at every tick; all other parts are float32.

    Most multiply-accumulates stay in float, so the cycles are taken to be those of single precision.
    """

    label: ClassVar[str] = "INT8"
    # No code is exported in this format; cycles of single precision stand for it.
    estimated: ClassVar[str] = "float32"
    rounded: ClassVar[bool] = False

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """Return one byte for each weight of a linear layer, four for the others, as in Table 4.9.

        No code is exported.
        """
        return dynamic_int8(predictor).weight_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """Return a copy that computes with the rounded weights."""
        return partial(stream_predictions, dynamic_int8(predictor).predictor)


@FORMATS.register("float32")
class Float32:
    """Everything in single precision; gains of weight norm are folded."""

    label: ClassVar[str] = "FP32"
    estimated: ClassVar[str] = "float32"
    rounded: ClassVar[bool] = False

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """Return all constants of the exported C code."""
        return estimate.parameter_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """Return the unchanged network."""
        return partial(stream_predictions, predictor)


@FORMATS.register("w8a16")
class W8A16:
    """Static quantisation of the whole network, evaluated in integer arithmetic (`edp.ir.w8a16`).

    A network that has no integer form is refused by name.
    """

    label: ClassVar[str] = "W8A16"
    estimated: ClassVar[str] = "w8a16"
    rounded: ClassVar[bool] = True

    def parameter_bytes(self, predictor: Predictor, estimate: Estimate) -> int:
        """Return all constants of the exported C code."""
        return estimate.parameter_bytes

    def predictions(self, predictor: Predictor, training_series: Sequence[Series]) -> Predict:
        """Return the ranges and weights are chosen on `training_series`."""
        return partial(stream_predictions, integer_predictor(predictor, training_series))


def resource_usage(
    predictor: Predictor, name: str, budget: Budget, parameter_bytes: int | None = None
) -> ResourceUsage:
    """Return memory and cycles of a network in the format `name` on the core of a budget.

    Args:
        predictor: the network; its weights need not be trained.
        name: a name of `FORMATS`.
        budget: says which core.
        parameter_bytes: size of the parameters, if it is known more precisely than from the format.

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
        predict: prediction function.
        resource_usage: resource usage.
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
    """Return a network in the format `name`.

    Args:
        predictor: the network, in float32.
        name: a name of `FORMATS`.
        training_series: training series, on which ranges of activations are found.
        budget: says for which core cycles are estimated.
        parameter_bytes: size of the parameters, if it is known more precisely than from the format.

    Raises:
        ConfigError: an unknown format, or a network that it cannot hold.
    """
    predict = FORMATS[name]().predictions(predictor, training_series)
    return Deployed(name, predict, resource_usage(predictor, name, budget, parameter_bytes))
