"""Sandbox layers: their purpose, the systems that have them, and the reaction to a missing layer.

The reader states its layers before it opens the log, so what it says cannot come from a hostile file. A missing layer
is announced once in each process. With the environment variable `EDP_SANDBOX` set to ``require``, or after
`require_layers`, a log is refused instead; with ``accept`` nothing is announced.
"""

from __future__ import annotations

import os
import platform
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from edp.errors import ConfigError, DataError

VARIABLE = "EDP_SANDBOX"
REQUIRE, ACCEPT = "require", "accept"
_LONGEST_REASON = 200
_PAGE = "docs/explanation/security.md"


@dataclass(frozen=True)
class SandboxLayer:
    """One layer of the sandbox.

    Attributes:
        name: name for messages and tables.
        stops: actions of native code in a reader that this layer prevents.
        needs: systems that have it.
        advice: advice if the layer is missing.
    """

    name: str
    stops: str
    needs: str
    advice: str


FILE_RULES = SandboxLayer(
    "file rules",
    "reading other files that you can read",
    "Linux 5.13 (Landlock) or 5.9 (files opened by another process)",
    "take such a kernel with CONFIG_SECURITY_LANDLOCK and 'landlock' in its parameter lsm=, or a container that "
    "passes on the calls landlock_* or seccomp",
)
SYSTEM_CALLS = SandboxLayer(
    "system-call filter",
    "sockets, programs, signals and limits of other processes, modes and times of files",
    "Linux on x86-64 and aarch64",
    "take such a kernel with CONFIG_SECCOMP_FILTER, or a container that passes on prctl(PR_SET_SECCOMP)",
)
LIMITS = SandboxLayer("limits", "unbounded memory and processor time", "POSIX systems", "use Linux, macOS or WSL")
AUDIT_HOOK = SandboxLayer("audit hook", "the same from Python code", "every system", "use CPython")
LAYERS = (FILE_RULES, SYSTEM_CALLS, LIMITS, AUDIT_HOOK)


class SandboxWarning(UserWarning):
    """A layer of the sandbox is missing."""


@dataclass
class _State:
    """State of the layers in this process.

    Attributes:
        required: logs are refused where a layer is missing.
        seen: why each layer is missing (empty where it holds), as the last reader said; None before the first log.
        announced: a missing layer was announced.
        announce: function that reports a missing layer.
    """

    required: bool = False
    seen: Mapping[str, str] | None = None
    announced: bool = False
    announce: Callable[[str], None] | None = None


_state = _State()


def require_layers(required: bool = True) -> None:
    """Refuse to read logs in this process where a layer of the sandbox is missing (as `EDP_SANDBOX=require` does)."""
    _state.required = required


def announce_by(announce: Callable[[str], None] | None) -> None:
    """Have a missing layer announced by a function instead of `warnings.warn`; None restores the latter."""
    _state.announce = announce


def get_seen_layers() -> Mapping[str, str] | None:
    """Return the reason for each missing layer (empty for a layer in force); None before the first log."""
    return _state.seen


def are_layers_required() -> bool:
    """Whether a log is to be refused where a layer is missing.

    Raises:
        ConfigError: the environment variable holds another word.
    """
    word = os.environ.get(VARIABLE, "")
    if word not in ("", REQUIRE, ACCEPT):
        raise ConfigError(
            f"{VARIABLE}: got {word[:40]!r}, expected '{REQUIRE}' or '{ACCEPT}'; '{REQUIRE}' refuses logs where a "
            f"layer of the sandbox is missing, '{ACCEPT}' reads them without a warning"
        )
    return _state.required or word == REQUIRE


def note_layers(path: Path, stated: object) -> None:
    """Record the layers that a reader reports, and warn of missing ones.

    Args:
        path: the log.
        stated: reason by name of layer, as it came from the reader.

    Raises:
        DataError: a layer is missing and the layers are required, or the reader says something else.
    """
    if not isinstance(stated, dict) or set(stated) != {layer.name for layer in LAYERS}:
        raise DataError(f"'{path}' cannot be read: its reader does not state the layers of its sandbox")
    _state.seen = {name: str(reason)[:_LONGEST_REASON] for name, reason in stated.items()}
    missing = [layer for layer in LAYERS if _state.seen[layer.name]]
    if not missing:
        return
    if are_layers_required():
        raise DataError(
            f"'{path}' is not read: {missing_text(missing)}, and {_wish()} asks for all layers. "
            + "; ".join(f"{layer.name} needs {layer.needs}: {layer.advice}" for layer in missing)
            + f"; or read the log without {_wish()} ({_PAGE})"
        )
    if not _state.announced and os.environ.get(VARIABLE) != ACCEPT:
        _state.announced = True
        text = (
            f"logs are read with less protection here: {missing_text(missing)}. A log made by a stranger could use "
            f"this. {VARIABLE}={REQUIRE} refuses logs instead, {VARIABLE}={ACCEPT} accepts this ({_PAGE})"
        )
        if _state.announce is None:
            warnings.warn(text, SandboxWarning, stacklevel=2)
        else:
            _state.announce(text)


def missing_text(missing: list[SandboxLayer]) -> str:
    """Return a sentence about the missing layers, the reasons, and their purpose."""
    seen = _state.seen or {}
    parts = [f"the layer '{layer.name}' of the sandbox is missing ({seen[layer.name]})" for layer in missing]
    system = f"{platform.system()} {platform.release()}"
    return f"{' and '.join(parts)} on {system}; it stops {' and '.join(layer.stops for layer in missing)}"


def _wish() -> str:
    return f"{VARIABLE}={REQUIRE}" if os.environ.get(VARIABLE) == REQUIRE else "require_layers()"
