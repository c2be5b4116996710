"""``--format simulink``: a folder that an engineer opens in MATLAB."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from edp.errors import ExportError
from edp.export.base import TARGETS
from edp.export.c.model import make_model
from edp.export.c.target import check_name, core_files
from edp.export.description import as_json, encode_mat, float_graph, golden
from edp.export.folder import write_export
from edp.export.onnx.metadata import notes
from edp.export.onnx.nodes import OPSETS
from edp.export.onnx.window import window_model
from edp.export.simulink.folder import Folder
from edp.training.bundle import Bundle

LONGEST_NAME = 20
"""Maximum number of characters of a network's name. MATLAB allows 63, and file names have suffixes."""
STUBS = ("simstruc.h", "cg_sfun.h", "simulink.c", "stub_run.h", "stub_main.c")


@TARGETS.register("simulink")
@dataclass(frozen=True)
class SimulinkTarget:
    """MATLAB and Simulink: S-function and C Caller around the C code; of float32 runs ``.m`` code and ONNX window too.

    Attributes:
        opset: opset of the ONNX window; 11 for importers of R2021b, see `OnnxTarget`.
        window: whether the ONNX window is written; it needs the package onnx.
    """

    # Opset 11 is what MATLAB's importers read from R2021b on.
    opset: int = 11
    window: bool = True

    def __post_init__(self) -> None:
        if self.opset not in OPSETS:
            raise ExportError(f"opset {self.opset} is not written; choose one of {', '.join(map(str, OPSETS))}")

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        if len(name) > LONGEST_NAME:
            raise ExportError(
                f"name '{name}' has {len(name)} characters; names of MATLAB functions begin with it: at most "
                f"{LONGEST_NAME} must hold, give another one with --name"
            )
        model = make_model(name, bundle)
        # There is no ONNX form in integer arithmetic, and no window of a plant.
        window = self.window and not model.integer and not model.graph.fed_back
        written = Folder(model, window)
        files: dict[str, bytes] = {file: text.encode() for file, text in written.texts().items()}
        files[f"{name}.json"] = as_json(written.content())
        files[f"{name}.mat"] = encode_mat({**written.tables(), "golden": golden(bundle.predictor, model.graph.window)})
        if window:
            graph = float_graph(bundle.predictor, "ONNX")
            targets, carried = len(bundle.task.targets), notes(written.described)
            files[f"{name}_window.onnx"] = window_model(graph, targets, f"{name}_window", carried, self.opset)
        files |= {f"core/{file}": text.encode() for file, text in core_files(model).items()}
        stubs = resources.files("edp.export.simulink").joinpath("stub")
        files |= {f"octave/{file}": stubs.joinpath(file).read_bytes() for file in STUBS}
        return write_export(folder, files)
