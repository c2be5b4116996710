"""Variables of a predictor as an FMU, in the order of their value references."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from edp.export.c.model import Model
from edp.export.escape import LONGEST_NAME, LONGEST_TEXT, shown_names, visible
from edp.export.si_names import si_channels, si_names
from edp.networks.input_range import usual_range
from edp.signals import KINDS, Kind

Form = Literal["real", "whole", "flag"]


@dataclass(frozen=True)
class Variable:
    """A variable; its value reference is its place in the list.

    Attributes:
        name: unique.
        causality: input, output or local.
        description: description for readers.
        form: real number, integer, or true and false.
        kind: physical quantity of a real number.
        nominal: usual size of a real number, SI unit.
    """

    name: str
    causality: Literal["input", "output", "local"]
    description: str
    form: Form = "real"
    kind: Kind = Kind.GENERIC
    nominal: float = 1.0

    @property
    def unit(self) -> str:
        """SI unit."""
        return KINDS[self.kind].si_unit


STATUS = "0 predicted; 1 warming up: fewer ticks than a window since a reset; 2 held: bad inputs; 3 no prediction"
OWN = (
    Variable("status", "output", STATUS, "whole"),
    Variable("valid", "output", "true if the predictions rest on this tick's inputs and a whole window", "flag"),
    Variable("rejected", "local", "ticks with bad inputs since the reset", "whole"),
    Variable("held", "local", "ticks fed with the last accepted inputs since the reset", "whole"),
    Variable("restarts", "local", "times the memory was cleared since the reset", "whole"),
)
"""Additional outputs after the inputs and predictions, in the order of ``edp_fmu.h``."""


def variables(model: Model) -> list[Variable]:
    """Return inputs, predictions and bounds in the order of the C structures, then the FMU's own variables."""
    _, spread = usual_range(model.bundle.predictor)
    entries = [
        Variable(entry.name, "input", entry.description, kind=entry.kind, nominal=_nominal(width))
        for entry, width in zip(si_channels(model.bundle.inputs), spread, strict=True)
    ]
    return unique(entries + _predictions(model) + list(OWN))


def _predictions(model: Model) -> list[Variable]:
    bundle, task = model.bundle, model.bundle.task
    widths = bundle.predictor.code.width.detach().cpu().double().numpy()
    ends_of = [("", "")]
    for side in ("lower", "upper"):
        for covered in bundle.predictor.output.coverages:
            percent = f"{100 * covered:g}"
            text = f", {side} bound of an interval meant to hold {percent} % of the true values"
            ends_of.append((f"_{side}_{percent.replace('.', '_')}", text))
    entries = []
    for ending, text in ends_of:
        for row, ticks in zip(widths, task.horizons, strict=True):
            when = f"{ticks} ticks ({1000 * ticks / task.rate_hz:g} ms) after the inputs of the last step"
            for at, name in enumerate(si_names(task.targets, bundle.target_kinds)):
                what = f"[{visible(name, LONGEST_NAME)}] {when}{text}"
                about = " ".join(part for part in (visible(bundle.descriptions[at]), what) if part)
                kind = bundle.target_kinds[at]
                entries.append(
                    Variable(f"{name}_ahead_{ticks}{ending}", "output", about, "real", kind, _nominal(row[at]))
                )
    return entries


def _nominal(width: float) -> float:
    """Return a width rounded to three digits; 1 for zero width."""
    # Three digits: a nominal value is an order of magnitude for the importer's tolerances.
    return float(f"{abs(width):.3g}") or 1.0


def unique(listed: list[Variable]) -> list[Variable]:
    """Return the variables with unique names and printable descriptions."""
    names = shown_names(entry.name for entry in listed)
    return [
        replace(entry, name=name, description=visible(entry.description, 2 * LONGEST_TEXT))
        for name, entry in zip(names, listed, strict=True)
    ]
