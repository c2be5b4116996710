"""Description common to all exported forms: names, units, order, rate, window, hashes; as JSON and MAT."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.golden import GOLDEN_TICKS, golden_recording, stream
from edp.export.hashes import model_hash, scale_hash
from edp.export.si_names import si_channels, si_names
from edp.ir import Graph
from edp.ir.hydraulics import HydraulicTick
from edp.networks.integer import IntegerPredictor
from edp.networks.predictor import Predictor
from edp.signals import KINDS, Kind
from edp.storage.reading import Table
from edp.training.bundle import Bundle

SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Description:
    """Network to be described.

    Attributes:
        name: name of the network in the exported form.
        bundle: the trained network.
        graph: its layers.
    """

    name: str
    bundle: Bundle
    graph: Graph

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the results as matrices: horizons, or intervals and horizons, by targets."""
        targets = len(self.bundle.task.targets)
        return {meaning: shape_of_result(self.graph, value, targets) for meaning, value in self.graph.results.items()}

    def content(self) -> Table:
        """Return the plain values that JSON can hold."""
        bundle, task = self.bundle, self.bundle.task
        kinds, texts = bundle.target_kinds, bundle.descriptions
        target_names = si_names(task.targets, kinds)
        return {
            "schema": SCHEMA,
            "edp": __version__,
            "name": self.name,
            "network": bundle.predictor.title,
            "number_format": bundle.predictor.number_format,
            "model_hash": model_hash(self.graph),
            "scale_hash": scale_hash(bundle.predictor),
            "rate_hz": task.rate_hz,
            "window": self.graph.window,
            "mode": str(task.mode),
            "inputs": [
                entry_of(c.name, own.name, c.kind, c.description)
                for c, own in zip(bundle.inputs, si_channels(bundle.inputs), strict=True)
            ],
            "targets": [
                entry_of(logged, name, kind, text)
                for logged, name, kind, text in zip(task.targets, target_names, kinds, texts, strict=True)
            ],
            "horizons": [{"ticks": k, "seconds": k / task.rate_hz} for k in task.horizons],
            "coverages": list(bundle.predictor.output.coverages),
            "results": {meaning: list(shape) for meaning, shape in self.shapes.items()},
        }


def entry_of(logged: str, name: str, kind: Kind, description: str) -> dict[str, str]:
    """Return one channel as plain values; ``original`` is its name in the log where that names another unit."""
    entry = {"name": name, "unit": KINDS[kind].si_unit, "kind": str(kind), "description": description}
    return entry if name == logged else entry | {"original": logged}


def shape_of_result(graph: Graph, value: str, targets: int) -> tuple[int, int]:
    """Return the shape of a result as a matrix: horizons, or intervals and horizons, by targets."""
    return graph.width_of(value) // targets, targets


def float_graph(predictor: Predictor, form: str, solves: bool = False) -> Graph:
    """Return the layer graph of a network in single precision, for export targets without integer arithmetic.

    Args:
        predictor: the network.
        form: name of the form.
        solves: whether it holds the equations of a grey box.

    Raises:
        ExportError: the network computes in integer arithmetic, or is a grey box.
    """
    if isinstance(predictor, IntegerPredictor):
        raise ExportError(
            f"the network computes in integer arithmetic ({predictor.number_format}), which {form} does not "
            "hold; export "
            "the run that it was quantised from, or take a form around the C code"
        )
    graph = predictor.graph()
    if not solves and has_equations(graph):
        raise ExportError(
            f"the equations of a grey box are solved by Newton's method, which has no form in {form}; export it to c, "
            "fmu, casadi, simulink or ros2"
        )
    return graph


def has_equations(graph: Graph) -> bool:
    """Return whether a layer contains the equations of a grey box."""
    return any(isinstance(layer, HydraulicTick) for layer in graph.layers)


def golden(predictor: Predictor, window: int) -> dict[str, object]:
    """Return a recording for comparison.

    Returns:
        Random `inputs` ``(tick, input)``; what PyTorch streams from them, `stream` ``(tick, number)``, the results of
        a tick one behind the other; what it predicts from the last `window` ticks alone, `window` ``(1, number)``; and
        the `tolerance` ``(1, number)``.
    """
    # At least a window: the window graph is compared on the last one.
    inputs, outputs, allowed = golden_recording(predictor, max(GOLDEN_TICKS, window))
    return {
        "inputs": inputs,
        "stream": outputs,
        "window": stream(predictor, inputs[-window:])[-1:],
        "tolerance": allowed[None],
    }


def as_json(content: Mapping[str, object]) -> bytes:
    """Return a description as a JSON file."""
    # NaN is no JSON; a reader in another language would fail on it.
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def encode_mat(variables: Mapping[str, object]) -> bytes:
    """Return variables as a MAT file (version 5) that is independent of the time of day.

    Lists become rows of numbers or cells.
    """
    import scipy.io  # late: training and search import this module

    buffer = io.BytesIO()
    scipy.io.savemat(
        buffer, {name: _convert_for_matlab(value) for name, value in variables.items()}, long_field_names=True
    )
    text = f"MATLAB 5.0 MAT-file, written by EDP {__version__}".ljust(116).encode()  # without the time of day
    return text + buffer.getvalue()[len(text) :]


def _convert_for_matlab(value: Any) -> Any:
    """Convert lists to rows of values or cells, and text to valid UTF-8."""
    if isinstance(value, str):
        # A lone surrogate has no UTF-8, in which text is written.
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, Mapping):
        return {key: _convert_for_matlab(entry) for key, entry in value.items()}
    if not isinstance(value, list):
        return value
    # An empty list becomes cells, as a list of texts would.
    if value and all(isinstance(entry, int | float) for entry in value):
        return np.array([value], dtype=float)
    cells = np.empty((1, len(value)), dtype=object)
    for at, entry in enumerate(value):
        cells[0, at] = _convert_for_matlab(entry)
    return cells
