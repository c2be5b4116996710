"""`edp evaluate` by a pool or a cluster: a unit each baseline, and one each part of the test for the network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from edp.config.experiment import build, plain_tree
from edp.evaluation.judge import JudgedModel, JudgedPart, JudgeSpec, ModelBench, by_effort, network_parts
from edp.jobs import Workforce
from edp.jobs.packing import packed, unpacked
from edp.jobs.units import UnitResult, WorkUnit, forget_units, run_units
from edp.logs.source import DataSource
from edp.networks.predictor import describe
from edp.progress import SILENT, Progress
from edp.settings.provenance import read_provenance
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path
from edp.training.blas import one_blas_thread
from edp.workflows.judged_data import judged_data
from edp.workflows.train_evaluate import evaluate, other_recordings, trained_run

UNITS, NETWORK = "units", "network"


def evaluate_with(
    workforce: Workforce,
    run: str | Path,
    source: DataSource | None = None,
    baselines: Sequence[str] | None = None,
    progress: Progress = SILENT,
    at_most_h: float | None = None,
) -> Path:
    """As `edp.workflows.train_evaluate.evaluate`, by a workforce: models run side by side.

    Args:
        workforce: who runs them; nodes see run and recordings under the same paths.
        run: run folder; what was measured stays in it until the scores are written.
        source: other recordings.
        baselines: names; None takes those of the settings.
        progress: receiver of a sentence when a model is done.
        at_most_h: as in `evaluate`.

    Returns:
        The folder with ``scores.json``.

    Raises:
        EdpError: as `evaluate`; `UnitError` where a model fails.
    """
    folder = Path(run)

    def by_units(bench: ModelBench, digest: str) -> dict[str, JudgedModel]:
        # Costly ones first, so that none of them begins last; parts of the network, all alike, fill what is left.
        names, spec = [*reversed(by_effort(bench.spec.baselines))], bench.spec
        parts = network_parts(bench.data)
        source_fields = None if source is None else source.to_plain()
        at = {"run": str(full_path(folder)), "source": source_fields, "at_most_h": at_most_h}
        models = [_unit(f"model '{name}'", {"model": name}, spec, digest, at) for name in names]
        runs = [
            _unit(f"network, part {part + 1} of {parts}", {"part": part}, spec, digest, at) for part in range(parts)
        ]

        def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
            progress.note(f"{unit.arguments.get('model', NETWORK)}, {done} of {len(models) + parts}")

        results = run_units([*models, *runs], workforce, folder / UNITS, note)
        judged = {
            name: unpacked(result.content or b"", JudgedModel)
            for name, result in zip(names, results[: len(models)], strict=True)
        }
        measured = (unpacked(result.content or b"", JudgedPart) for result in results[len(models) :])
        label, seconds = describe(bench.predictor.spec), read_provenance(folder).seconds or 0.0
        judged[NETWORK] = bench.network_of(measured, label, seconds)
        return {name: judged[name] for name in [NETWORK, *by_effort(spec.baselines)]}

    scored = evaluate(folder, source, baselines, judged_by=by_units, at_most_h=at_most_h)
    forget_units(folder / UNITS)
    return scored


def _unit(label: str, does: Mapping[str, Any], spec: JudgeSpec, digest: str, where: Mapping[str, Any]) -> WorkUnit:
    return WorkUnit(f"{__name__}:judge_model", label, {**does, "judge": plain_tree(spec)}, digest, where)


@one_blas_thread()
def judge_model(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Scores of one baseline, or what the network of a run measures on one part, and what pictures show of it."""
    spec = build(JudgeSpec, identity.config["judge"], "of the unit")
    source = json.dumps(where["source"], sort_keys=True)
    bench = _bench(where["run"], identity.data, source, where["at_most_h"], spec)
    if "part" in identity.config:
        return WithState({"part": identity.config["part"]}, packed(bench.network_part(identity.config["part"])))
    name = identity.config["model"]
    return WithState({"model": name}, packed(bench.baseline(name)))


@lru_cache(maxsize=1)
def _bench(run: str, digest: str, source: str, at_most_h: float | None, spec: JudgeSpec) -> ModelBench:
    """A run with its data, once for all that a process measures of them.

    Args:
        run: run folder.
        digest: of the data, so that changed data are read anew.
        source: other recordings as JSON.
        at_most_h: as in `edp.workflows.train_evaluate.evaluate`.
        spec: how to judge.
    """
    bundle, _, provenance, data = trained_run(Path(run))
    other = json.loads(source)
    others = other_recordings(None if other is None else DataSource.from_plain(other), provenance)
    data, _ = judged_data(bundle, data, others, at_most_h)
    return ModelBench(bundle.predictor, data, spec)
