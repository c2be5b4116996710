"""Fits the constants of an adaptation to a run's own recordings, and writes a run that has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.config.experiment import experiment_toml
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError
from edp.evaluation.adaptation_file import AdaptationFile
from edp.ir.rls import Adaptation, AdaptationSpec
from edp.ir.rls.constants import FEATURE_LIMIT
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.signals import Kind
from edp.storage import write_bytes, write_json
from edp.storage.paths import is_file_at
from edp.storage.runs import Run, check_claimable, run_key
from edp.training import save_bundle
from edp.training.bundle import weights_digest
from edp.workflows.adaptation.replay import replay
from edp.workflows.deployment import footprint_of
from edp.workflows.train_evaluate import read_trained_run

Rows = NDArray[np.float64]
HISTORY = "history.jsonl"


@dataclass(frozen=True, eq=False)
class AdaptedRun:
    """Result of `adapt`.

    Attributes:
        adaptation: adaptation with fitted constants.
        content: content of ``adaptation.json``.
    """

    adaptation: Adaptation
    content: AdaptationFile


def adapt(run: str | Path, out: str | Path, spec: AdaptationSpec | None = None) -> AdaptedRun:
    """Write a run whose network has an adaptation: it is exported with it and replayed with it.

    Args:
        run: run folder, in single precision or integer (W8A16).
        out: folder of the new run.
        spec: options.

    Returns:
        The adaptation, and its errors on the run's test recordings.

    Raises:
        EdpError: not a run folder, a network whose predictions are not measured later, or a folder that holds another
            run.
    """
    check_claimable(out, "adaptation")
    folder = Path(run)
    bundle, experiment, provenance, data = read_trained_run(folder)
    spec = spec or AdaptationSpec()
    key = run_key({"adaptation": asdict(spec), "weights": weights_digest(bundle.predictor)}, data.digest)
    # Before the folder is claimed: what is refused must not keep a corrected command out.
    adaptation = fit_adaptation(bundle.predictor, data, spec)
    with Run.create(out, "adaptation", key, experiment_toml(experiment)) as target:
        if is_file_at(folder / HISTORY):
            write_bytes(target.file(HISTORY), (folder / HISTORY).read_bytes())
        write_json(target.file("provenance.json"), provenance.add_entries(adaptation=adaptation.digest).to_table())
        save_bundle(replace(bundle, adaptation=adaptation), target.file("bundle"))
        # The footprint counts the adaptation too; the one of the source run would state too little.
        write_json(target.file("footprint.json"), footprint_of(target.path)[0].to_json())
        content = replay(bundle.predictor, adaptation, data.test).content(data.task, data.target_kinds)
        content.write(target.path)
    return AdaptedRun(adaptation, content)


def fit_adaptation(predictor: Predictor, data: Prepared, spec: AdaptationSpec) -> Adaptation:
    """Return the scales, directions and units of an adaptation.

    Directions are the leading principal components of the training inputs, standardised, without the targets
    themselves, which are features of their own. Units are the spread of the network's errors on the validation part.

    Raises:
        ConfigError: a target is no input, so that it is not known whether a prediction came true; a horizon of 0; or
            more directions than inputs.
    """
    task = data.task
    hidden = [name for name in task.targets if name not in task.inputs]
    if hidden:
        raise ConfigError(
            f"{', '.join(hidden)} is predicted, but not measured on board: no input of the network; nothing tells "
            "whether a prediction came true, so it cannot adapt"
        )
    columns = tuple(task.inputs.index(name) for name in task.targets)
    inputs = np.concatenate([part.inputs for part in data.train]).astype(np.float64)
    offset, scale = inputs.mean(axis=0), _widths(inputs)
    present = inputs[:, list(columns)]
    # Velocities rest at zero by nature; the median of other targets is where the machine usually is.
    middle = np.where([kind is Kind.VELOCITY for kind in data.target_kinds], 0.0, np.median(present, axis=0))
    # Units come from the validation part: errors on training data are too small.
    change, unit = _measure_spread(predictor, data.validation)
    arrays = {
        "offset": offset,
        "scale": scale,
        "directions": _directions((inputs - offset) / scale, columns, spec.rank),
        "middle": middle,
        "spread": _widths(present),
        "change": change,
        "unit": unit,
    }
    float_arrays = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in arrays.items()}
    return Adaptation(spec=spec, rate_hz=task.rate_hz, horizons=task.horizons, columns=columns, **float_arrays)


def _widths(rows: Rows) -> Rows:
    """Return standard deviations; 1 for constant columns."""
    deviations = rows.std(axis=0)
    # A relative threshold: rounding gives a constant column of pressures a spread above zero.
    return np.where(deviations > 1e-9 * (1.0 + np.abs(rows).max(axis=0)), deviations, 1.0)


def _directions(scaled: Rows, columns: Sequence[int], rank: int) -> Rows:
    """Return the leading principal components ``(rank, inputs)``, each of them scaled to a spread of 1."""
    cut = np.clip(scaled, -FEATURE_LIMIT, FEATURE_LIMIT)
    # The targets are features of their own; directions need not tell them again.
    cut[:, list(columns)] = 0.0
    possible = int((cut.std(axis=0) > 0).sum())
    if rank > possible:
        raise ConfigError(f"adaptation: rank = {rank}, but only {possible} inputs besides the targets move; lower it")
    values, vectors = np.linalg.eigh(np.cov(cut, rowvar=False))
    # `eigh` sorts upwards; the leading components are the last.
    chosen = np.argsort(values)[::-1][:rank]
    axes = vectors[:, chosen] / np.sqrt(values[chosen])
    # The sign of an eigenvector is arbitrary; the largest entry made positive gives the same numbers everywhere.
    signs = np.sign(axes[np.abs(axes).argmax(axis=0), range(rank)])
    return np.asarray((axes * signs).T)


def _measure_spread(predictor: Predictor, parts: Sequence[Series]) -> tuple[Rows, Rows]:
    """Spread of predicted changes and of errors ``(horizon, target)``."""
    skip, horizons = predictor.spec.window, predictor.task.horizons
    changes: list[list[Rows]] = [[] for _ in horizons]
    errors: list[list[Rows]] = [[] for _ in horizons]
    for predicted, series in zip(stream_predictions(predictor, parts), parts, strict=True):
        for h, k in enumerate(horizons):
            predictions = predicted[skip : series.samples - k, h].astype(np.float64)
            changes[h].append(predictions - series.targets[skip : series.samples - k])
            errors[h].append(predictions - series.targets[skip + k :])
    return _spreads(changes), _spreads(errors)


def _spreads(parts: list[list[Rows]]) -> Rows:
    return np.stack([_widths(np.concatenate(of)) for of in parts])
