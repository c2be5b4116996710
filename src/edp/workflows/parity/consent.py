"""Consent to compile and run a bundle: given for run folders of this computer's owner, required for others."""

from __future__ import annotations

from pathlib import Path

from edp.storage.paths import is_file_at

RUN = ("run.json", "provenance.json")
"""Training and distillation write both beside a bundle, quantisation and adaptation the second; a bundle that is passed
on has neither."""
WHAT = (
    "edp verify writes C, Python and MATLAB code of this network, compiles it and runs it on this computer with your "
    "rights. The code holds numbers and sizes of the bundle, and its text in comments and strings only"
)


def from_own_run(path: str | Path) -> bool:
    """Return whether a path is a run folder, or the bundle in one.

    A convenience and no proof: a folder that somebody sent whole looks like one of your own.
    """
    folder = Path(path)
    return any(
        # The bundle of a run lies one folder below it.
        is_file_at(candidate / name)
        for candidate in (folder, *([folder.parent] if folder.name == "bundle" else []))
        for name in RUN
    )
