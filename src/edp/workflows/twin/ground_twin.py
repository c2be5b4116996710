"""``edp twin LOGS --start RUN --set ground=NAME``: a grey box of free air learns the ground from logs in soil."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from edp.config.twin import TWIN_SETTINGS, TwinExperiment, twin_toml
from edp.errors import ConfigError
from edp.evaluation.free_run_file import RUNS, FreeRunFile, StepResponses
from edp.logs.source import DataSource
from edp.networks.twin import TWINS
from edp.networks.twin.grey.datasheet import BASIS
from edp.networks.twin.grey.ground import check_grounded
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.parameters import Datasheet
from edp.progress import SILENT, Progress
from edp.storage import write_bytes
from edp.storage.paths import is_file_at
from edp.storage.runs import Run, run_key
from edp.training.ground_fit import fit_ground
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin, twin_hash
from edp.workflows.twin.continue_twin import BaseTwin
from edp.workflows.twin.prepare_twin import cut_recordings

FOLDER = "twin"
JUDGED = (FreeRunFile.NAME, RUNS, StepResponses.NAME)
"""What the evaluation of a twin leaves in its run."""
GROUND_BASIS = (
    "those of the ground from least squares on forces along logs in soil, errors of 2 s taken as one; numbers of a "
    "direction are not below zero, whatever their intervals say"
)


def ground_twin(
    source: DataSource,
    experiment: TwinExperiment,
    out: str | Path,
    start: str | Path | None,
    progress: Progress = SILENT,
) -> tuple[TwinBundle, bool]:
    """Fit a law of the ground and write a run folder: the twin of `start` with it, settings, datasheet.

    Equations, scores and intervals stay those of free air, and so do the free runs that its page shows.

    Args:
        source: recordings in soil.
        experiment: settings that name a ground.
        out: run folder; a finished one is read.
        start: run folder of a grey box with a known linkage.
        progress: receiver of what begins.

    Returns:
        The twin, and whether it was finished before.

    Raises:
        EdpError: no such start, or recordings, settings or folder cannot be used.
    """
    base, linkage = _base(start)
    experiment = base.settled(experiment)
    progress.note("reading recordings")
    channels, data = cut_recordings(source.read(), experiment)
    base.check(channels, data.train)
    key = run_key({"twin": TWIN_SETTINGS.to_dict(experiment), "from": base.digest}, data.digest)
    with Run.create(out, "twin", key, twin_toml(experiment)) as run:
        if run.is_finished:
            return load_twin(run.path), True
        progress.note(f"fitting the ground '{experiment.ground}' to forces along the logs")
        twin = check_grounded(base.bundle.twin)
        fitted = fit_ground(experiment.ground, twin, data.train, data.validation, linkage)
        earlier = Datasheet.read(base.folder).numbers if is_file_at(base.folder / Datasheet.NAME) else ()
        # A ground that is fitted anew replaces the one before.
        rows = (*(row for row in earlier if row.element != "ground"), *fitted.datasheet)
        Datasheet(basis=f"{BASIS}; {GROUND_BASIS}", numbers=rows).write(run.path)
        contact = {"source": source.label, "digest": data.digest}
        facts = {**fitted.facts, **base.provenance(), "ground_data": contact}
        bundle = replace(base.bundle, ground=fitted.law, provenance=base.bundle.provenance.add_entries(**facts))
        for name in JUDGED:
            # In free air it is the twin that was judged there, so its page needs no evaluation of its own.
            if is_file_at(base.folder / name):
                write_bytes(run.file(name), (base.folder / name).read_bytes())
        save_twin(bundle, run.file(FOLDER))
    return bundle, False


def _base(start: str | Path | None) -> tuple[BaseTwin, str]:
    """Return the start twin, and the machine of its linkage.

    Raises:
        EdpError: no twin is named, or it cannot have a ground.
    """
    if start is None:
        raise ConfigError(
            "ground: a grey box of logs in free air comes first; name its run with --start, or leave ground out"
        )
    bundle = load_twin(start)
    if not isinstance(bundle.spec, GreyBox):
        raise ConfigError(
            f"ground with --start {start}: the twin is of kind '{TWINS.name_of(bundle.spec)}'; a grey box with "
            "twin.linkage must hold"
        )
    check_grounded(bundle.twin)
    return BaseTwin(Path(start), bundle, twin_hash(start)), bundle.spec.linkage
