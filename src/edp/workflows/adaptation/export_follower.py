"""``edp export RUN --format follower --twin GREY``: a grey box that follows the machine, as C99 without heap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

from edp.errors import BundleError, ConfigError, closest
from edp.export.follower import FollowerParts, write_follower
from edp.networks.twin.adaptive_twin import TunedSpec
from edp.networks.twin.greybox import GreyTwin
from edp.training import load_bundle
from edp.training.twin_bundle import load_twin, plant_bundle
from edp.workflows.adaptation.with_twin import choose_tuned_spec, correction_of

OPTIONS = tuple(one.name for one in fields(TunedSpec) if one.name != "groups")
"""Options of `TunedSpec` that the user may set."""


def export_follower(
    run: str | Path, twin: str | Path, folder: str | Path, name: str, options: Mapping[str, str] | None = None
) -> list[Path]:
    """Write a grey box that follows the machine, and moves the predictions of a run towards its forecasts, as C99.

    Args:
        run: run with an adaptation. The units of its channels define what a large correction is.
        twin: run folder of the grey box of the machine as it was.
        folder: output folder.
        name: prefix of its C functions and files.
        options: options of `TunedSpec` by name.

    Returns:
        The files, the one to read first in front.

    Raises:
        EdpError: a run without adaptation, a twin that does not go with it, a name or an option that cannot be.
    """
    bundle = load_bundle(run)
    if bundle.adaptation is None:
        raise BundleError(f"'{run}' has no adaptation; edp adapt {run} --out FOLDER makes a run that has one")
    grey = load_twin(twin)
    spec = _apply_options(choose_tuned_spec(grey), options or {})
    correction = correction_of(grey.twin, bundle.adaptation, bundle.task, spec)
    if not isinstance(grey.twin, GreyTwin):  # refused by the line above; this tells the type
        raise ConfigError("only a grey box can follow the machine")
    parts = FollowerParts(
        title=f"a grey box of {len(correction.tuned.labels)} groups of numbers",
        twin=grey.twin,
        spec=spec,
        targets=bundle.task.targets,
        horizons=bundle.adaptation.horizons,
        limit=correction.limit,
    )
    return write_follower(parts, plant_bundle(grey), name, Path(folder))


def _apply_options(spec: TunedSpec, options: Mapping[str, str]) -> TunedSpec:
    changed: dict[str, float] = {}
    for option, text in options.items():
        if option not in OPTIONS:
            raise ConfigError(
                f"--set {option}: a follower has no such option{closest(option, OPTIONS)}; it has {', '.join(OPTIONS)}"
            )
        try:
            changed[option] = int(text) if option == "learn_ticks" else float(text)
        except ValueError as error:
            raise ConfigError(f"--set {option}={text[:40]}: a number must hold") from error
    return replace(spec, **changed)  # type: ignore[arg-type]
