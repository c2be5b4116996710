"""Export target ``--format onnx``: the graphs of a network, and files that describe inputs and outputs."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from edp.errors import ExportError
from edp.export.base import TARGETS
from edp.export.description import Description, as_json, encode_mat, float_graph, golden
from edp.export.escape import LONGEST_NAME, visible
from edp.export.folder import write_export
from edp.export.onnx.metadata import content, expand_starts, notes
from edp.export.onnx.nodes import DEFAULT_OPSET, OPSETS
from edp.export.onnx.step import states_of, step_model
from edp.export.onnx.window import window_model
from edp.export.sizes import check_numbers
from edp.training.bundle import Bundle


@TARGETS.register("onnx")
@dataclass(frozen=True)
class OnnxTarget:
    """ONNX, float32: ``NAME_step.onnx``, ``NAME_window.onnx``, and ``NAME.json`` and ``NAME.mat``, which describe them.

    Attributes:
        opset: version of the operators; 13 goes with most readers, 9 and 11 with old ones.
    """

    opset: int = DEFAULT_OPSET

    def __post_init__(self) -> None:
        if self.opset not in OPSETS:
            raise ExportError(f"opset {self.opset} is not written; choose one of {', '.join(map(str, OPSETS))}")

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        # The name is part of files and of graph names, which importers turn into identifiers.
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", name):
            raise ExportError(
                f"name '{visible(name, LONGEST_NAME)}' is that of files and graphs: up to 31 lower-case letters, "
                "digits, underscores, a letter first; give another one with --name"
            )
        check_numbers(bundle)
        graph = float_graph(bundle.predictor, "ONNX")
        described, states = Description(name, bundle, graph), states_of(graph)
        targets, carried = len(bundle.task.targets), notes(described)
        files = {"step": step_model(graph, targets, f"{name}_step", carried, self.opset)}
        # A tick of a plant waits for the answer of the one before: nothing runs over a window at once.
        if not graph.fed_back:
            files["window"] = window_model(graph, targets, f"{name}_window", carried, self.opset)
        about = content(described, files, states, self.opset)
        tables = {"edp": expand_starts(about, states), "golden": golden(bundle.predictor, graph.window)}
        contents = {f"{name}.json": as_json(about), f"{name}.mat": encode_mat(tables)}
        contents |= {f"{name}_{kind}.onnx": data for kind, data in files.items()}
        return write_export(folder, contents)
