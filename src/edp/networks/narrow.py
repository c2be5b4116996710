"""Students: the same network, narrower and less deep."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec
from edp.networks.predictor import ModelSpec


def width_of(model: ModelSpec) -> int:
    """Return the width that names a network: its recurrent units, or the channels of its first level."""
    units = getattr(model.backbone, "units", None)
    return int(units if units is not None else model.backbone.channels[0])  # type: ignore[attr-defined]


def student(model: ModelSpec, units: int, levels: int | None = None) -> ModelSpec:
    """Return a network of the same parts with all widths scaled to `units` and fewer convolution levels.

    The thesis's students (Table 4.9): half or a quarter of the teacher's units, channels and head width, and of three
    convolution levels the first two. A committee keeps one
    perceptron of each activation, and neither trees nor radial basis functions.

    Args:
        model: the teacher's specs.
        units: recurrent units, or channels of the first level where nothing recurs.
        levels: convolution levels to keep, from the input on; None for one less than the teacher has, at least one
            (a pure TCN keeps all, since its receptive field must span the window).

    Raises:
        ConfigError: units below 1 or above the teacher's, levels that the teacher does not have, or a committee without
            perceptrons.
    """
    full = width_of(model)
    if not 1 <= units <= full:
        raise ConfigError(f"student: units = {units}; 1 <= units <= {full}, those of the teacher, must hold")

    def narrower(width: int) -> int:
        return max(1, round(width * units / full))

    changed: dict[str, object] = {}
    names: set[str] = {entry.name for entry in fields(model.backbone)} if is_dataclass(model.backbone) else set()
    if "units" in names:
        changed["units"] = units
    if "trees" in names:
        # A student learns by gradients, which no tree does: its trees would give zero for good.
        changed["trees"] = 0
    if isinstance(model.backbone, CommitteeSpec):
        if not model.backbone.activations:
            raise ConfigError(
                "student: a committee without perceptrons (activations = []) has no width; it is a linear model and "
                "tables already, export it as it is"
            )
        # Many members and nearness to typical rows steady what is fitted to noise; what a teacher says has none.
        changed |= {"members": 1, "centres": 0, "local_lags": ()}
    if "channels" in names:
        channels = model.backbone.channels  # type: ignore[attr-defined]
        if levels is None:
            levels = max(1, len(channels) - 1) if "units" in names else len(channels)
        if not 1 <= levels <= len(channels):
            raise ConfigError(
                f"student: levels = {levels}; 1 <= levels <= {len(channels)}, those of the teacher, must hold"
            )
        changed["channels"] = tuple(narrower(width) for width in channels[:levels])
    elif levels is not None:
        raise ConfigError(f"student: levels = {levels}, but the teacher has no convolutions; leave it out")
    head = model.head
    if "hidden" in {entry.name for entry in fields(head)}:  # type: ignore[arg-type]
        head = replace(head, hidden=narrower(head.hidden))  # type: ignore[type-var]
    return replace(model, backbone=replace(model.backbone, **changed), head=head)  # type: ignore[type-var]
