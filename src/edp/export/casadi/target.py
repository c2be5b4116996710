"""``--format casadi``: a module and data from which CasADi builds the step, and C code behind an external function."""

from __future__ import annotations

import io
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.base import TARGETS
from edp.export.c.model import make_model
from edp.export.c.target import check_name, core_files
from edp.export.casadi.external import blanks
from edp.export.casadi.states import places, start
from edp.export.description import Description, as_json, float_graph, golden, has_equations
from edp.export.escape import fill
from edp.export.folder import write_export
from edp.ir import Graph, Layer
from edp.ir.kinds import FLOAT_KINDS
from edp.training.bundle import Bundle

RULES = {
    "order": "inputs and targets in the order of this file, in SI units",
    "reset": "feed `start` as x at the first tick, and again after a gap or a change of machine",
    "missed_tick": "feed the inputs of the tick before again; after five in a row reset",
    "bad_input": "NaN or infinite inputs give NaN, in the prediction or in the next state; the external refuses them",
    "warming_up": "after a reset the first `window` predictions do not rest on a whole window",
}
INDEX_IMPORT = "from edp.networks.twin.grey import parameter_index as at"
EQUATIONS_IMPORT = "from edp.networks.twin.grey.equations import"
GOLDEN = ("inputs", "stream", "tolerance")


@TARGETS.register("casadi")
@dataclass(frozen=True)
class CasadiTarget:
    """CasADi, float32 runs: ``edp_casadi.py``, ``NAME.json`` and ``NAME.npz``, and C with ``NAME_casadi.c`` (external).

    ``edp_horizon.py`` runs a horizon of the compiled C. An export of a grey box contains ``edp_hydraulics.py``,
    ``edp_equations.py`` and ``edp_parameter_index.py`` instead of C, because the C code of a grey box has no tangents.
    """

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        graph = float_graph(bundle.predictor, "CasADi", solves=True)
        data, described = arrays(graph), content(Description(name, bundle, graph))
        # The recording covers a whole window at least, so that every ring has been round once.
        golden_run = golden(bundle.predictor, graph.window)
        here = resources.files("edp.export.casadi")
        files: dict[str, bytes] = {
            "edp_casadi.py": here.joinpath("runtime.py").read_bytes(),
            f"{name}.json": as_json(described),
            f"{name}.npz": packed(data),
            f"{name}_golden.npz": packed(
                {key: np.asarray(golden_run[key]) for key in ("inputs", "stream", "tolerance")}
            ),
        }
        if has_equations(graph):
            return write_export(folder, files | equation_files())
        files["edp_horizon.py"] = here.joinpath("horizon.py").read_bytes()
        files[f"{name}_casadi.c"] = external(graph, name).encode()
        model = make_model(name, bundle, tangent=True)
        files |= {file: text.encode() for file, text in core_files(model).items()}
        return write_export(folder, files)


def equation_files() -> dict[str, bytes]:
    """Return the Python modules of the grey-box equations by file name.

    The exported modules import each other from their own folder, without the `edp` package.
    """
    grey = resources.files("edp.networks.twin.grey")
    modules = {
        "edp_hydraulics.py": resources.files("edp.export.casadi").joinpath("hydraulics.py"),
        "edp_equations.py": grey.joinpath("equations.py"),
        "edp_parameter_index.py": grey.joinpath("parameter_index.py"),
    }
    files = {}
    for name, source in modules.items():
        text = source.read_text(encoding="utf-8").replace(INDEX_IMPORT, "import edp_parameter_index as at")
        files[name] = text.replace(EQUATIONS_IMPORT, "from edp_equations import").encode()
    return files


def content(described: Description) -> dict[str, object]:
    """Return the description of the network in JSON types: common part, layers, states and rules."""
    graph = described.graph
    return described.content() | {
        "rules": RULES,
        "layers": [_layer(layer) for layer in graph.layers],
        "values": dict(graph.results),
        "states": [
            {"layer": state.layer, "slot": state.slot.name, "rows": state.rows, "columns": state.columns}
            for state in places(graph)
        ],
    }


def arrays(graph: Graph) -> dict[str, np.ndarray]:
    """Return the constants by layer and name, and the state after a reset."""
    tensors = {f"{layer}/{name}": values for layer, name, values in graph.tensors()}
    return tensors | {"start": start(graph)}


def _layer(layer: Layer) -> dict[str, object]:
    if type(layer) not in FLOAT_KINDS:
        raise ExportError(
            f"layer '{layer.name}' is a {type(layer).__name__}, which has no form in CasADi; "
            f"these have: {', '.join(sorted(kind.__name__ for kind in FLOAT_KINDS))}"
        )
    return {"kind": layer.kind, "constants": list(layer.tensors())} | layer.options()


def packed(data: dict[str, np.ndarray]) -> bytes:
    """Return arrays as a NumPy file without pickled objects."""
    buffer = io.BytesIO()
    # Objects in a NumPy file are pickles, which execute code when read.
    np.savez(buffer, allow_pickle=False, **data)
    return buffer.getvalue()


def external(graph: Graph, name: str) -> str:
    """Return the C file that CasADi calls."""
    text = resources.files("edp.export.casadi").joinpath("external.c.in").read_text()
    return fill(text, blanks(graph, name) | {"version": __version__})
