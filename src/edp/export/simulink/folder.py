"""Template values of a MATLAB folder, and the choice of templates for a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources

import numpy as np

from edp import __version__
from edp.export.c.model import Model
from edp.export.c.text import indented
from edp.export.description import SCHEMA, Description
from edp.export.escape import LONGEST_NAME, Code, fill, markdown_text, matlab_names, visible
from edp.export.hashes import model_hash, scale_hash
from edp.export.simulink.native import Native, functions_for
from edp.ir.base import Number
from edp.networks.input_range import HOLD_TICKS, input_limits
from edp.storage.reading import Table

RULES = {
    "order": "inputs and targets in the order of this file, in SI units",
    "reset": "clears memory and counts before the tick",
    "missed_tick": "the last accepted inputs are fed again; after five in a row the memory is cleared",
    "bad_input": "NaN, infinite or far too large inputs are rejected as a whole, counted, and the tick is held",
    "no_prediction": "results are NaN with status 3 (restarted) and 4 (not reset)",
    "present_value": "inside: nothing is to be added to the results",
}
STATUS = ("ok", "warming", "held", "restarted", "not_reset")
"""Names of a sample's status, by number."""
FIRST = {
    True: Code("form = 'native';"),
    False: Code("forms = {'sfun', 'octave'};\n    form = forms{1 + (exist('OCTAVE_VERSION', 'builtin') > 0)};"),
}
"""Form that is compared by default, depending on whether plain MATLAB code is available."""
C_FILES = ("sfun.c", "call.h", "call.c")
MATLAB_FILES = ("load", "names", "rows", "octave", "build", "bus", "simulate", "golden")
NATIVE_FILES = ("step", "reset", "stream")
ABOUT = {
    "golden.m": ("compares the other files with the golden recording", ""),
    "build.m": ("makes the S-function and a model with both blocks", "Simulink, a C compiler"),
    "sfun.c": ("level-2 S-function around `core/`: the block that streams", "Simulink"),
    "call.c": ("the function of a C Caller block, its state as a port", "Simulink"),
    "call.h": ("its declaration, for the model's custom code", "Simulink"),
    "bus.m": ("bus type of the measurements, with units", "Simulink"),
    "simulate.m": ("streams rows through the S-function in Simulink", "Simulink"),
    "load.m": ("weights, description and golden recording", ""),
    "step.m": ("one tick in plain MATLAB", ""),
    "reset.m": ("the state of one machine before its first tick", ""),
    "stream.m": ("a whole recording in plain MATLAB", ""),
    "names.m": ("refuses signals that are missing or in another order", ""),
    "rows.m": ("rows of inputs from a struct, table or timetable, by name", ""),
    "window.onnx": ("the last window in, predictions out; for tools that keep windows", "ONNX importer"),
    "onnx.m": ("imports the window and predicts with it", "Deep Learning Toolbox"),
    "octave.m": ("runs the S-function in GNU Octave", "Octave, mkoctfile"),
}
"""Description and requirements of each file in the README table."""


@dataclass(frozen=True, eq=False)
class Folder:
    """Texts of a MATLAB folder.

    Attributes:
        model: the C code within.
        window: whether the ONNX window is there.
    """

    model: Model
    window: bool

    @property
    def described(self) -> Description:
        """Description common to all forms."""
        return Description(self.model.name, self.model.bundle, self.model.graph)

    @property
    def native(self) -> Native | None:
        """Network as MATLAB code; None for integer arithmetic and grey boxes."""
        return None if self.model.integer or self.model.hydraulic else Native(self.model.graph)

    def content(self) -> Table:
        """Return the description in JSON types."""
        about = self.described.content()
        for side in ("inputs", "targets"):
            fields = matlab_names([entry["name"] for entry in about[side]])
            about[side] = [entry | {"field": field} for entry, field in zip(about[side], fields, strict=True)]
        return about | {"rules": RULES, "status": list(STATUS)}

    def tables(self) -> dict[str, object]:
        """Return the content of the MAT file without the golden recording."""
        low, high = input_limits(self.model.bundle.predictor)
        tables: dict[str, object] = {"edp": self.content()}
        if self.native is not None:
            ends = {"low": low, "high": high}
            tables |= {side: values.astype(np.float32).reshape(-1, 1) for side, values in ends.items()}
            tables |= {"weights": self.native.weights(), "start": self.native.start()}
        return tables

    def texts(self) -> dict[str, str]:
        """Return all text files but the C code of the core; the README first."""
        name = self.model.name
        file_names = [*(f"{part}.m" for part in MATLAB_FILES), *C_FILES]
        file_names += [f"{part}.m" for part in NATIVE_FILES] if self.native is not None else []
        file_names += ["onnx.m"] if self.window else []
        files = {"README.md": self._fill("README.md"), "rtwmakecfg.m": self._fill("rtwmakecfg.m")}
        return files | {f"{name}_{part}": self._fill(part) for part in file_names}

    def _fill(self, part: str) -> str:
        text = resources.files("edp.export.simulink").joinpath(f"templates/{part}.in").read_text()
        return fill(text, self._values)

    @cached_property
    def _values(self) -> Mapping[str, object]:
        model, about = self.model, self.content()
        task, graph = model.bundle.task, model.graph
        sources = [f"{model.name}.c", *(file for file in model.runtime if file.endswith(".c"))]
        fields = [entry["field"] for entry in about["inputs"]]
        return {
            "name": model.name,
            "NAME": model.name.upper(),
            "title": markdown_text(model.bundle.predictor.title),
            "version": __version__,
            "schema": SCHEMA,
            "model_hash": model_hash(graph),
            "scale_hash": scale_hash(model.bundle.predictor),
            "format": about["number_format"],
            "mode": about["mode"],
            "period": repr(1.0 / task.rate_hz),
            "rate": f"{task.rate_hz:g}",
            "tick_ms": f"{1000.0 / task.rate_hz:g}",
            "window": graph.window,
            "hold": HOLD_TICKS,
            "inputs": graph.inputs,
            "numbers": sum(rows * columns for rows, columns in self.described.shapes.values()),
            "results": len(graph.results),
            "sources": Code(", ".join(f"'{file}'" for file in sources)),
            "selected": Code(",".join(fields)),
            "state_bytes": model.state_bytes(),
            "words": self.words,
            **self._ports(),
            **self._matlab(),
            **self._readme(about),
        }

    @property
    def words(self) -> int:
        """Number of 32-bit words of the C state, including padding by the compiler."""
        short = sum(slot.number is Number.INT16 for _, slot in self.model.graph.slots())
        short += sum(kind is Number.INT16 for kind in self.model.plan.sizes)
        # Each 16-bit array may be followed by two bytes of padding; the sum is rounded up to words.
        return (self.model.state_bytes() + 2 * short + 7) // 4

    def _ports(self) -> dict[str, object]:
        """Return the result ports of the S-function and the results of the C Caller's function."""
        sizes: list[str] = []
        give: list[str] = []
        # MATLAB's matrices have columns first, C's have rows first.
        copies: list[str] = []
        ports, arguments = [], []
        for port, (meaning, (rows, columns)) in enumerate(self.described.shapes.items()):
            size = f"MatrixDimensions(S, {port}, {columns}, {rows})" if rows > 1 else f"Width(S, {port}, {columns})"
            sizes += [f"ssSetOutputPort{size};", f"ssSetOutputPortDataType(S, {port}, SS_SINGLE);"]
            at = f"ssGetOutputPortSignal(S, {port})"
            for lines, where, there in ((give, at, "out->"), (copies, meaning, "out.")):
                cast = f"(real32_T *){where}" if lines is give else where
                lines += ["if (found) {", f"    memcpy({where}, {there}{meaning}, sizeof {there}{meaning});"]
                lines += ["} else {", f"    fill_nan({cast}, {rows * columns});", "}"]
            ports.append(f"{port} {meaning}, single [{columns} x {rows}], a column for each horizon")
            arguments.append(f"float {meaning}[{rows * columns}]")
        count = len(ports)
        ports += [
            f"{count} status, int32: an edp_status",
            f"{count + 1} counts, uint32 [4]: ticks, rejected, held, restarts",
        ]
        many = len(self.model.bundle.predictor.output.coverages) > 1
        return {
            "sizes": indented(sizes),
            "give": indented(give),
            "copy": indented(copies),
            "ports": Code("\n *               ".join(ports)),
            "arguments": Code(", ".join(arguments)),
            "columns": Code("; of bounds interval by interval") if many else "",
            "out_names": Code(", ".join(f"'{meaning}'" for meaning in self.described.shapes)),
            "ports_count": str(count + 2),
        }

    def _matlab(self) -> dict[str, object]:
        """Code of the tick, and of the comparison with the golden recording."""
        shapes = self.described.shapes
        forms = {"octave": "found = {0}_octave(net.golden.inputs);", "sfun": "found = {0}_simulate(net.golden.inputs);"}
        if self.native is not None:
            forms = {"native": "found = {0}_stream(net, net.golden.inputs);"} | forms
        if self.window:
            forms["onnx"] = "found = {0}_onnx(net.golden.inputs);\n        wanted = double(net.golden.window);"
        cases = "\n".join(f"    case '{form}'\n        {line.format(self.model.name)}" for form, line in forms.items())
        values: dict[str, object] = {
            "cases": Code(cases),
            "forms": Code(" or ".join(f"'{form}'" for form in forms)),
            "form_names": ", ".join(forms),
            "first_form": FIRST[self.native is not None],
            "exact": "Integers must be the same." if self.model.integer else "",
            "layout": Code(
                "; ".join(f"{meaning} {r} x {c} (horizons by targets)" for meaning, (r, c) in shapes.items())
            ),
            "bounds": ", OUT.lower and OUT.upper bounds" if len(shapes) > 1 else "",
            "nothing": Code(
                "\n".join(f"out.{meaning} = nan({r}, {c}, 'single');" for meaning, (r, c) in shapes.items())
            ),
            "shaped": Code(
                "\n".join(
                    f"out.{meaning} = reshape(found.{meaning}, {c}, {r}).';" for meaning, (r, c) in shapes.items()
                )
            ),
        }
        if self.native is None:
            return values
        code = self.native.code()
        return values | {"code": code, "given": self.native.results(), "functions": functions_for(code)}

    def _readme(self, about: Table) -> dict[str, object]:
        """Return the tables of the README."""
        name, there = self.model.name, self._there()
        rows = [f"| `{name}_{part}` | {what} | {needs} |" for part, (what, needs) in ABOUT.items() if part in there]
        rows += [
            f"| `{name}.json`, `{name}.mat` | names, units, order, rate, window, mode, hashes; golden recording | |",
            "| `rtwmakecfg.m` | where the C files of the S-function are, for code generation | Simulink Coder |",
            "| `core/` | the C code: model and runtime | |",
            "| `octave/` | stand-ins for Simulink's headers, for checks in Octave; keep them off MATLAB's path | |",
        ]
        table = ["| Input | Unit | Bus element | What it is |", "|---|---|---|---|"]
        for entry in about["inputs"]:
            shown = markdown_text(visible(entry["name"], LONGEST_NAME))
            about_it = markdown_text(entry["description"])
            table.append(f"| {shown} | {entry['unit']} | {entry['field']} | {about_it} |")
        checked = f"`{name}_golden('octave')` runs the S-function in GNU Octave against stand-ins of Simulink's headers"
        if self.native is not None:
            checked += f", and `{name}_golden('native')` the plain MATLAB code"
        missing = "" if self.window else "\n\nThe ONNX window is not in this folder."
        if self.model.integer:
            missing = "\n\nThe network computes in integer arithmetic: C code only, no plain MATLAB code and no ONNX."
        elif self.native is None:
            missing = (
                "\n\nThe equations of a grey box are solved by C code only: there is no plain MATLAB code of them."
            )
        first = f" `{name}_golden` then compares the plain MATLAB code with PyTorch."
        return {
            "first_check": Code(first) if self.native is not None else "",
            "files": Code("\n".join(rows)),
            "inputs_table": Code("\n".join(table)),
            "checked": Code(checked + "." + missing),
            "onnx_unchecked": Code(f" the import of `{name}_window.onnx`,") if self.window else "",
        }

    def _there(self) -> set[str]:
        parts = {*(f"{part}.m" for part in MATLAB_FILES), *C_FILES}
        parts |= {f"{part}.m" for part in NATIVE_FILES} if self.native is not None else set()
        return parts | ({"onnx.m", "window.onnx"} if self.window else set())
