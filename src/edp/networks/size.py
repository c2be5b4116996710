"""Upper bound on the size of a network, computed from its options before it is built."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from edp.data.task import Task

# Forty times the largest network of the thesis (1.2 million); controllers hold a hundred thousand. 0.2 GB as float32.
MOST_PARAMETERS = 50_000_000
# Numbers that a stream carries from tick to tick: 0.4 GB as float32, and a training has a stream for each lane.
MAX_STATE = 100_000_000
NO_WIDTHS = (
    *("kernel", "layers", "window", "ticks", "taps", "heads", "reduction", "first_dilations"),
    *("lags", "smoothed", "local_lags"),
)
"""Options that are integers, but not the width of anything."""


def size_at_most(spec: Any, task: Task) -> tuple[int, int]:
    """Return upper bounds of parameters and state elements of a network, at most ten times too large.

    Args:
        spec: a `ModelSpec`.
        task: channels to read and to predict.
    """
    # Options alone: building a network to count it could exhaust the memory that is to be protected.
    options = list(_integers((spec.backbone, spec.head, *spec.blocks)))
    features, targets = len(task.features.features), len(task.targets)

    def most(name: str) -> int:
        return max((value for key, value in options if key == name), default=1)

    width = max([features, *(value for key, value in options if key not in NO_WIDTHS)])
    spans = sum(key in ("lags", "smoothed") for key, _ in options)
    if spans:  # the representation of a committee: changes over each span, and all members
        # Two groups of members at most: one for each of the two activations.
        width = features * (1 + spans) + 2 * most("members") * most("units") + targets * len(task.horizons)
    levels = sum(key == "channels" for key, _ in options)
    stacks = max(1, sum(key == "first_dilations" for key, _ in options))
    layers = sum(value for key, value in options if key == "layers")
    squares = (
        2 * most("kernel") * levels * stacks  # two convolutions a level
        + 6 * (stacks + 1) * layers  # gates on the input and on the state
        + 8 * stacks**2  # attention and feed-forward network behind the convolutions
        + 4  # pooling and further features
        + targets * (13 + layers)  # full gates and heads
    )
    values = len(task.horizons) * spec.output.values
    ends = targets * values * (2 * width + features * most("taps"))
    small = 64 * stacks * (targets + levels + layers + 1) * width  # biases, norms, gates by feature
    reach = (
        spec.window
        + 2 * most("kernel") * most("first_dilations") * 2**levels
        + most("taps")
        + most("ticks")
        + 2 * most("lags")
    )
    # A tree has two numbers a node and one a leaf.
    tables = targets * len(task.horizons) * max(0, most("trees")) * 3 * 2 ** most("tree_depth") if spans else 0
    # Those on few columns read twice the features at most, and every output reads each of them.
    near = sum(key == "local_lags" for key, _ in options) * most("centres") * (2 * features + 2 + targets * values)
    spans_state = sum(2 * entry.ticks(task.rate_hz) for entry in task.features.derived)
    parameters = squares * width**2 + ends + small + tables + near
    return parameters, spans_state + 4 * reach * stacks * (levels + layers + 2) * width


def _integers(parts: tuple[Any, ...] | list[Any], name: str = "") -> Iterator[tuple[str, int]]:
    for part in parts:
        if is_dataclass(part):
            for entry in fields(part):
                yield from _integers([getattr(part, entry.name)], entry.name)
        elif isinstance(part, tuple):
            yield from _integers(part, name)
        elif isinstance(part, int) and not isinstance(part, bool):
            yield name, part
