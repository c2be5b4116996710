"""Excavator Dynamics Predictor: learn a deployable plant model of a hydraulic machine from recordings.

The public names are imported when they are first asked for, so that ``import edp`` costs nothing.
docs/reference/python.md describes them, `__init__.pyi` states their types.
"""

from importlib import import_module
from warnings import warn

__version__ = "0.1.0"

_API = "edp.workflows.api"
_PUBLIC = {
    "ComparedRuns": f"{_API}.compare",
    "EdpError": "edp.errors",
    "JudgedScores": f"{_API}.scores",
    "Monitor": "edp.monitor.monitor",
    "Predictions": f"{_API}.predictions",
    "Recording": "edp.recording",
    "Recordings": f"{_API}.recordings",
    "SearchStudy": f"{_API}.scores",
    "Stream": "edp.networks.stream",
    "TrainedPredictor": f"{_API}.predictor",
    "compare": f"{_API}.compare",
    "load": f"{_API}.predictor",
    "load_monitor": "edp.monitor.monitor_file",
    "load_study": f"{_API}.scores",
    "load_twin": "edp.training.twin_bundle",
    "read": f"{_API}.recordings",
    "testing": "",
    "train": f"{_API}.training",
}
"""Where each public name is defined; an empty text is a module of its own."""

__all__ = (  # noqa: PLE0604 - the names of the table, and nothing else
    "__version__",
    *_PUBLIC,
)


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'edp' has no attribute '{name}'")
    module = _PUBLIC[name]
    value = getattr(import_module(module), name) if module else import_module(f"edp.{name}")
    # After the import: a plug-in takes from EDP what it builds on.
    for failure in import_module("edp.registry").load_plugins():
        warn(failure, stacklevel=2)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
