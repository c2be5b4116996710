"""What a reader of the ONNX files must know: names, units, order, states and their starts, rules; JSON and MAT."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.io

from edp import __version__
from edp.export.golden import GOLDEN_TICKS, random_inputs, stream, tolerance
from edp.export.hashes import model_hash, scale_hash
from edp.export.onnx.nodes import OPSETS
from edp.export.onnx.step import INPUTS, State, shape_of_result
from edp.graph import Graph
from edp.models.predictor import describe as describe_network
from edp.signals import KINDS
from edp.training.bundle import Bundle

SCHEMA = 1
RULES = {
    "order": "inputs and targets in the order of this file, in SI units",
    "reset": "step: feed every state's start at the first tick, and again after a gap or a change of machine",
    "missed_tick": "step: feed the inputs of the tick before again; after five in a row reset",
    "bad_input": "NaN or infinite inputs make every result NaN; in step those of all later ticks too, until a reset",
    "warming_up": "step: after a reset the first `window` predictions do not rest on a whole window",
    "several_machines": "step: each has states of its own",
}


@dataclass(frozen=True, eq=False)
class Description:
    """What is described.

    Attributes:
        name: prefix of the files.
        bundle: the trained network.
        graph: its layers.
        states: of the step graph.
        opset: of the graphs.
    """

    name: str
    bundle: Bundle
    graph: Graph
    states: tuple[State, ...]
    opset: int


def notes(described: Description) -> dict[str, str]:
    """What the ONNX files themselves carry."""
    task = described.bundle.task
    return {
        "inputs": json.dumps([channel.name for channel in described.bundle.inputs]),
        "targets": json.dumps(list(task.targets)),
        "horizons_ticks": json.dumps(list(task.horizons)),
        "rate_hz": f"{task.rate_hz:g}",
        "window": str(described.graph.window),
        "mode": str(task.mode),
        "model_hash": model_hash(described.graph),
        "scale_hash": scale_hash(described.bundle.predictor),
    }


def as_json(described: Description, files: Mapping[str, bytes]) -> bytes:
    """The description as JSON; `files` are the graphs, by kind."""
    return (json.dumps(content(described, files), indent=1, allow_nan=False) + "\n").encode()


def content(described: Description, files: Mapping[str, bytes]) -> dict[str, Any]:
    """The description as plain values."""
    bundle, graph, task = described.bundle, described.graph, described.bundle.task
    kinds, texts = bundle.target_kinds, bundle.descriptions
    shapes = {meaning: shape_of_result(graph, value, len(task.targets)) for meaning, value in graph.results.items()}
    return {
        "schema": SCHEMA,
        "edp": __version__,
        "name": described.name,
        "network": describe_network(bundle.predictor.spec),
        "model_hash": model_hash(graph),
        "scale_hash": scale_hash(bundle.predictor),
        "rate_hz": task.rate_hz,
        "window": graph.window,
        "mode": str(task.mode),
        "inputs": [
            {"name": c.name, "unit": c.unit, "kind": str(c.kind), "description": c.description} for c in bundle.inputs
        ],
        "targets": [
            {"name": name, "unit": KINDS[kind].si_unit, "kind": str(kind), "description": text}
            for name, kind, text in zip(task.targets, kinds, texts, strict=True)
        ],
        "horizons": [{"ticks": k, "seconds": k / task.rate_hz} for k in task.horizons],
        "coverages": list(bundle.predictor.output.coverages),
        "results": {meaning: list(shape) for meaning, shape in shapes.items()},
        "rules": RULES,
        "graphs": {kind: _graph(described, kind, data) for kind, data in files.items()},
    }


def _graph(described: Description, kind: str, data: bytes) -> dict[str, Any]:
    ticks = described.graph.window if kind == "window" else 1
    about: dict[str, Any] = {
        "file": f"{described.name}_{kind}.onnx",
        "sha256": hashlib.sha256(data).hexdigest(),
        "opset": described.opset,
        "ir": OPSETS[described.opset],
        "input": INPUTS,
        "shape": [ticks, described.graph.inputs],
    }
    if kind == "window":
        return about
    states = [
        {"name": state.name, "next": state.next, "shape": list(state.start.shape), "start": _start(state)}
        for state in described.states
    ]
    return about | {"states": states}


def _start(state: State) -> float | list[list[float]]:
    """One number where all are the same."""
    first = float(state.start.flat[0])
    same = np.all(state.start == state.start.flat[0])
    return first if same else [[float(value) for value in row] for row in state.start]


def as_mat(described: Description, files: Mapping[str, bytes]) -> bytes:
    """The description as a MAT file (version 5): ``edp``, a struct as the JSON file, and ``golden``.

    ``golden`` has random `inputs` ``(tick, input)``; what PyTorch streams from them, `stream` ``(tick, number)``, the
    results of a tick one behind the other; what it predicts from the last window alone, `window` ``(1, number)``; and
    the `tolerance` ``(1, number)``.
    """
    predictor, window = described.bundle.predictor, described.graph.window
    inputs = random_inputs(predictor, max(GOLDEN_TICKS, window), seed=0)
    outputs = stream(predictor, inputs)
    golden = {
        "inputs": inputs,
        "stream": outputs,
        "window": stream(predictor, inputs[-window:])[-1:],
        "tolerance": tolerance(predictor, inputs, outputs)[None],
    }
    about = content(described, files)
    for entry, state in zip(about["graphs"]["step"]["states"], described.states, strict=True):
        entry["start"] = state.start
    made = io.BytesIO()
    scipy.io.savemat(made, {"edp": _for_matlab(about), "golden": golden}, long_field_names=True)
    text = f"MATLAB 5.0 MAT-file, written by EDP {__version__}".ljust(116).encode()  # without the time of day
    return text + made.getvalue()[len(text) :]


def _for_matlab(value: Any) -> Any:
    """Lists as rows of numbers or as cells."""
    if isinstance(value, dict):
        return {key: _for_matlab(entry) for key, entry in value.items()}
    if not isinstance(value, list):
        return value
    if value and all(isinstance(entry, int | float) for entry in value):
        return np.array([value], dtype=float)
    cells = np.empty((1, len(value)), dtype=object)
    for at, entry in enumerate(value):
        cells[0, at] = _for_matlab(entry)
    return cells
