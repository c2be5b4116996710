"""FMUs as files: descriptions, sources, libraries and documentation packed for each version of FMI."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources

from edp.errors import ExportError
from edp.export.escape import Code, c_string, fill
from edp.export.fmu.build import PLATFORMS, Sources, libraries
from edp.export.fmu.describe import About, build_description, fmi2, fmi3
from edp.export.fmu.page import page
from edp.storage.archives import zip_bytes

COMMON = ("edp_fmu.h", "edp_fmu.c")
OWN: Mapping[int, tuple[str, ...]] = {
    2: ("edp_fmi2.h", "edp_fmi2.c"),
    3: ("edp_fmi3.h", "edp_fmi3.c", "edp_fmi3_absent.c"),
}
"""Source files of the FMI interface by FMI version."""
VERSIONS = {"2": (2,), "3": (3,), "both": (2, 3)}
BINARIES = {"both": tuple(PLATFORMS), **{name: (name,) for name in PLATFORMS}, "none": ()}
# The earliest date that a ZIP file can hold.
DATE = (1980, 1, 1, 0, 0, 0)
"""Date of every file in an FMU. A fixed date gives identical bytes for identical networks."""


def check_choice(version: str, binaries: str) -> None:
    """Refuse an unsupported version or choice of binaries.

    Raises:
        ExportError: no such version or binaries.
    """
    if binaries not in BINARIES:
        raise ExportError(f"binaries '{binaries}' are not built; choose one of {', '.join(BINARIES)}")
    if version not in VERSIONS:
        raise ExportError(f"FMI version '{version}' is not written; choose one of {', '.join(VERSIONS)}")


def token_of(texts: Iterable[str]) -> str:
    """Return a content address in the form of a GUID, computed from everything that decides behaviour or interface."""
    state = hashlib.blake2b(digest_size=16)
    for text in (*texts, *plumbing(*COMMON, *OWN[2], *OWN[3]).values()):
        # The zero byte separates texts: two files cannot be shifted into one another.
        state.update(text.encode() + b"\0")
    return "{" + str(uuid.UUID(bytes=state.digest())) + "}"


def model_header(about: About, required: int, tangent: str = "") -> str:
    """Return the header that connects the FMI code to the model.

    Args:
        about: the model.
        required: inputs that count as missing until they are set; those behind them are zero.
        tangent: definitions of its derivatives.
    """
    text = resources.files("edp.export.fmu").joinpath("templates/fmu_model.h.in").read_text()
    names = Code(", ".join(c_string(entry.name) for entry in about.listed if entry.causality == "input"))
    values: dict[str, object] = {"name": about.name, "NAME": about.name.upper(), "token": Code(about.token)}
    values |= {"required": required, "rate": repr(about.rate_hz), "step": repr(about.step_s), "names": names}
    return fill(text, values | {"tangent": Code(tangent)})


def fmu_files(
    about: About, core: Mapping[str, str], description: bytes, version: str, binaries: str
) -> dict[str, bytes]:
    """Return the FMUs of a model by file name.

    Args:
        about: content of the XML files.
        core: C code of the model by file name, `model_header` as ``fmu_model.h`` among it.
        description: JSON, a file of its resources.
        version: a name of `VERSIONS`.
        binaries: a name of `BINARIES`.

    Raises:
        ExportError: no compiler, or it refuses the code.
    """
    versions = VERSIONS[version]
    texts = plumbing(*COMMON, *(file for v in versions for file in OWN[v]))
    common = c_files((*core, *COMMON))
    own = {v: c_files(OWN[v]) for v in versions}
    built = libraries(Sources(about.name, {**core, **texts}, common, own), BINARIES[binaries])
    files = {}
    for v in versions:
        # Only the plumbing of its own version: two sets of entry points would clash in one library.
        sources = {**core, **{file: texts[file] for file in (*COMMON, *OWN[v])}}
        content = _content(v, about, sources, description)
        files[f"{about.name}_fmi{v}.fmu"] = _zip(content | built[v])
    return files


def _content(version: int, about: About, sources: Mapping[str, str], description: bytes) -> dict[str, bytes]:
    """Return content of an FMU without libraries, by path."""
    compiled = c_files(tuple(sources))
    files = {"modelDescription.xml": fmi2(about, compiled) if version == 2 else fmi3(about)}
    files["documentation/index.html"] = page(about)
    files[f"resources/{about.name}.json"] = description
    files |= {f"sources/{file}": text.encode() for file, text in sources.items()}
    if version == 3:
        files["sources/buildDescription.xml"] = build_description(about, compiled)
    return files


def plumbing(*names: str) -> dict[str, str]:
    """Return the files of the FMU's own code."""
    return {name: resources.files("edp.export.fmu").joinpath(f"plumbing/{name}").read_text() for name in names}


def c_files(names: Sequence[str]) -> list[str]:
    """Return the C files to compile."""
    return [name for name in names if name.endswith(".c")]


def _zip(content: Mapping[str, bytes]) -> bytes:
    # Executable rights: without them the libraries cannot be loaded after unpacking on Linux.
    return zip_bytes(content.items(), DATE, 0o755)
