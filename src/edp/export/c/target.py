"""``--format c``: the folder of a model with its runtime, test and example."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from edp.errors import ExportError
from edp.export.base import TARGETS
from edp.export.c.model import Model, make_model
from edp.export.c.text import reference_array
from edp.export.escape import C_WORDS, LONGEST_NAME, MATLAB_WORDS, visible
from edp.export.folder import write_export
from edp.export.golden import GOLDEN_TICKS, golden_recording
from edp.training.bundle import Bundle

# A header of these names in the include path would hide the system's.
_HEADERS = """
assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic stdbool
stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar unistd wchar wctype
mex matrix tmwtypes simstruc cg_sfun rtwtypes windows
"""
_OWN = "in out s work work16 work32 main host_test fuzz example_task fmu_model simulink stub_run stub_main driver"
_CMAKE = "all clean depend edit_cache help install package package_source preinstall rebuild_cache test"
RESERVED = C_WORDS | MATLAB_WORDS | frozenset(re.findall(r"\w+", f"{_HEADERS} {_OWN} {_CMAKE}"))
"""Names that a model must not have: language keywords, headers that ``NAME.h`` would hide, identifiers of the files,
CMake targets.
"""


@TARGETS.register("c")
@dataclass(frozen=True)
class CTarget:
    """C99, float32 or w8a16: ``NAME.h``, ``NAME.c``, constants, runtime, host test, fuzzer, example task, CMake.

    Attributes:
        tangent: whether to write ``NAME_tangent.h`` and ``NAME_tangent.c``: derivatives of predictions by inputs and
            past; float32.
        adapts: whether this form holds the adaptation of a bundle that has one: ``NAME_adaptation.h`` and ``.c``.
    """

    adapts: ClassVar[bool] = True

    tangent: bool = False

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        model = make_model(name, bundle, self.tangent, adapts=True)
        files = core_files(model) | {
            f"{name}_golden.h": golden(model),
            "host_test.c": model.fill("host_test.c.in"),
            "fuzz.c": model.fill("fuzz.c.in"),
            "example_task.c": model.fill("example_task.c.in"),
            "CMakeLists.txt": model.fill("CMakeLists.txt.in"),
        }
        return write_export(folder, {file: text.encode() for file, text in files.items()})


def core_files(model: Model) -> dict[str, str]:
    """Model and runtime as text by file name: what every form around the C code holds; the header comes first."""
    name = model.name
    files = {
        f"{name}.h": model.fill("model.h.in"),
        f"{name}.c": model.fill("model.c.in"),
        f"{name}_weights.h": model.weights(),
    }
    if model.changes is not None:
        files |= {f"{name}_tangent.{end}": model.fill(f"model_tangent.{end}.in") for end in ("h", "c")}
    if model.adapts:
        files |= {f"{name}_adaptation.{end}": model.fill(f"model_adaptation.{end}.in") for end in ("h", "c")}
    return files | model.runtime_texts()


def check_name(name: str) -> None:
    """Refuse an invalid C name of a model.

    Raises:
        ExportError: it cannot.
    """
    # 31 characters and a prefix stay within the 63 that C99 compares; lower case for file systems without case.
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", name) or name in RESERVED or name.startswith("edp_"):
        raise ExportError(
            f"name '{visible(name, LONGEST_NAME)}' is the prefix of C functions and files: up to 31 lower-case "
            "letters, digits, underscores, a letter first, not beginning with edp_, no word of C, C++ or MATLAB, no "
            "header of C, no target of CMake; give another one with --name"
        )


def golden(model: Model) -> str:
    """Return inputs and the outputs of PyTorch as a C header, for the test on a computer."""
    predictor = model.bundle.predictor
    inputs, outputs, allowed = golden_recording(predictor, GOLDEN_TICKS)
    text = [f"/* Random inputs of {model.name} and the network's predictions, bounds behind them. */"]
    text.append(f"#define GOLDEN_TICKS {len(inputs)}u")
    for name, values in (("inputs", inputs), ("outputs", outputs), ("tolerance", allowed)):
        text.append(reference_array("float", f"golden_{name}", values))
    return "\n".join(text) + "\n"
