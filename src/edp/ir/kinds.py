"""Every kind of float layer."""

from __future__ import annotations

from edp.ir import hydraulics, layers, memory
from edp.ir.base import Layer

FLOAT_KINDS: frozenset[type[Layer]] = frozenset(
    kind
    for module in (layers, memory, hydraulics)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Layer) and kind.__module__ == module.__name__
    if not kind.__name__.startswith("_")
)
