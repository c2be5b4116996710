"""Cost of a trained network, and its export."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edp.config.experiment import load_experiment
from edp.data.derived_velocities import matched
from edp.errors import ConfigError
from edp.evaluation.controller import Budget
from edp.evaluation.footprint import Footprint, check_possible, footprint
from edp.evaluation.mac_check import check_counted
from edp.export import TARGETS, make_target
from edp.ir.rls import Adaptation
from edp.ir.w8a16 import calibrate
from edp.logs.source import DataSource
from edp.networks.integer import IntegerPredictor
from edp.networks.narrow import student
from edp.networks.predictor import ModelSpec, Predictor, build_model, describe
from edp.networks.twin import IntegerTwinPlant, TwinPlant
from edp.storage import write_json
from edp.training import load_bundle
from edp.training.bundle import Bundle, blank_scaler
from edp.training.twin_bundle import holds_twin, load_twin, plant_bundle


def footprint_of(path: str | Path, budget: Budget | None = None) -> tuple[Footprint, str]:
    """Return the footprint of a bundle, a run folder or a settings file, and its name.

    Raises:
        EdpError: neither a bundle nor valid settings, a budget that no network of these inputs and targets meets, or a
            part that counts other work than it does.
    """
    predictor, name, adaptation = _predictor_of(path)
    # Stated counts are held to what runs before anybody relies on them.
    check_counted(predictor)
    if budget is not None:
        alone = replace(predictor.spec, blocks=(), physics=None)
        # One unit without blocks is the smallest network of these inputs: if it is too large, all are.
        check_possible(budget, footprint(_build_untrained(student(alone, units=1), predictor.task)))
    return footprint(predictor, adaptation), name


def state_budget(run: str | Path, budget: Budget) -> None:
    """Hold the network of a run against a controller, and keep the verdict in the run's ``footprint.json``.

    Raises:
        EdpError: `run` is not a run of a network, no network of its inputs and targets meets the budget, or the file
            cannot be written.
    """
    counts, _ = footprint_of(run, budget)
    write_json(Path(run) / "footprint.json", counts.to_json(budget))


def _predictor_of(path: str | Path) -> tuple[Predictor, str, Adaptation | None]:
    source = Path(path)
    if source.suffix == ".toml":
        experiment = load_experiment(source)
        # A settings file names no rate; counts do not depend on it, so the thesis's 100 Hz stands in.
        task = experiment.task.resolve(100.0, physics=experiment.model.physics)
        return _build_untrained(experiment.model, task), source.stem, None
    bundle = load_bundle(source)
    predictor = bundle.predictor
    # Integer networks have the counts of the network that they were quantised from.
    counted = predictor.to_float_network() if isinstance(predictor, IntegerPredictor) else predictor
    return counted, describe(predictor.spec), bundle.adaptation


def forms() -> dict[str, str]:
    """Return the first line of each form's description by name."""
    return {name: (target.__doc__ or "").strip().partition("\n")[0] for name, target in TARGETS.items()}


def export_bundle(
    path: str | Path,
    to: str,
    folder: str | Path,
    name: str = "predictor",
    options: Mapping[str, object] | None = None,
    calibration: DataSource | None = None,
) -> list[Path]:
    """Write a bundle or the bundle of a run folder in the form `to`; returns the files, the one to read first in front.

    Args:
        path: bundle, or run folder.
        to: name of the form.
        folder: output folder.
        name: name of the network in the files.
        options: options of the form.
        calibration: recordings for the conversion of a twin to W8A16.

    Raises:
        EdpError: not a bundle, an unknown form or option, or a network or name that this form cannot hold.
    """
    target, bundle = make_target(to, options), load_exported(path)
    return target.write(bundle if calibration is None else quantise_twin(bundle, calibration), name, Path(folder))


def quantise_twin(bundle: Bundle, calibration: DataSource) -> Bundle:
    """Return a twin whose cell computes in W8A16; complete recordings determine formats and weights.

    Raises:
        ConfigError: not a twin.
        DataError: a channel is missing, not finite or of another kind, or the rate is another one.
    """
    plant = bundle.predictor
    if not isinstance(plant, TwinPlant):
        raise ConfigError(
            "only a twin is brought into W8A16 while it is exported; a network by edp compress quantise RUN"
        )
    channels, rows = plant.twin.channels, []
    for recording in calibration.read():
        series = channels.task().series(matched(channels, recording))
        rows.append(np.concatenate([series.inputs, series.targets, np.ones_like(series.targets)], axis=1))
    return replace(bundle, predictor=IntegerTwinPlant(plant, calibrate(plant.graph(), rows)))


def load_exported(path: str | Path) -> Bundle:
    """Load the bundle of a predictor, or a twin as a bundle of a plant.

    Raises:
        BundleError: neither, or damaged.
    """
    return plant_bundle(load_twin(path)) if holds_twin(path) else load_bundle(path)


def unheld_adaptation(path: str | Path, to: str) -> bool:
    """Return whether a bundle has an adaptation that the form `to` leaves out."""
    return load_exported(path).adaptation is not None and not getattr(TARGETS[to], "adapts", False)


def _build_untrained(model: ModelSpec, task: Any) -> Predictor:
    return build_model(task, model, blank_scaler(task), seed=0)
