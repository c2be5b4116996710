"""Description of the ONNX files in addition to the common part: graphs, states and their initial values, rules."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

import numpy as np

from edp.export.description import Description
from edp.export.onnx.nodes import OPSETS
from edp.export.onnx.step import INPUTS, State
from edp.storage.reading import Table

RULES = {
    "order": "inputs and targets in the order of this file, in SI units",
    "reset": "step: feed every state's start at the first tick, and again after a gap or a change of machine",
    "missed_tick": "step: feed the inputs of the tick before again; after five in a row reset",
    "bad_input": "NaN or infinite inputs make every result NaN; in step those of all later ticks too, until a reset",
    "warming_up": "step: after a reset the first `window` predictions do not rest on a whole window",
    "several_machines": "step: each has states of its own",
}


def notes(described: Description) -> dict[str, str]:
    """Return the metadata stored in the ONNX files."""
    about = described.content()
    return {
        "inputs": json.dumps([channel["name"] for channel in about["inputs"]]),
        "targets": json.dumps([target["name"] for target in about["targets"]]),
        "horizons_ticks": json.dumps([ahead["ticks"] for ahead in about["horizons"]]),
        "rate_hz": f"{about['rate_hz']:g}",
        "window": str(about["window"]),
        "mode": about["mode"],
        "model_hash": about["model_hash"],
        "scale_hash": about["scale_hash"],
    }


def content(
    described: Description, files: Mapping[str, bytes], states: Sequence[State], opset: int
) -> dict[str, object]:
    """Return the description of the graphs in JSON types; `files` are the graphs, by kind."""
    graphs = {kind: _graph(described, kind, data, opset) for kind, data in files.items()}
    if "step" in graphs:
        graphs["step"]["states"] = [
            {"name": state.name, "next": state.next, "shape": list(state.start.shape), "start": _start(state)}
            for state in states
        ]
    return described.content() | {"rules": RULES, "graphs": graphs}


def expand_starts(about: Table, states: Sequence[State]) -> dict[str, object]:
    """Return `content` with whole arrays as the starts of states, for MATLAB."""
    # MATLAB has no rule for the short form of a start.
    step = about["graphs"]["step"]
    full = [entry | {"start": state.start} for entry, state in zip(step["states"], states, strict=True)]
    return about | {"graphs": about["graphs"] | {"step": step | {"states": full}}}


def _graph(described: Description, kind: str, data: bytes, opset: int) -> dict[str, object]:
    ticks = described.graph.window if kind == "window" else 1
    return {
        "file": f"{described.name}_{kind}.onnx",
        "sha256": hashlib.sha256(data).hexdigest(),
        "opset": opset,
        "ir": OPSETS[opset],
        "input": INPUTS,
        "shape": [ticks, described.graph.inputs],
    }


def _start(state: State) -> float | list[list[float]]:
    """Return one number where all are the same."""
    # A single number keeps the JSON readable; rings hold hundreds of equal ones.
    first = float(state.start.flat[0])
    same = np.all(state.start == state.start.flat[0])
    return first if same else [[float(value) for value in row] for row in state.start]
