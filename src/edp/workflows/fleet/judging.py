"""`edp evaluate` by a pool or a cluster: a unit the network, and one each baseline."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from edp.config.experiment import build, plain_tree
from edp.data.prepared import Prepared
from edp.evaluation.judge import JudgedModel, JudgeSpec, ModelBench, by_effort
from edp.logs.source import DataSource
from edp.networks.predictor import describe
from edp.storage.ledger import TrainingIdentity, WithState
from edp.training import Bundle
from edp.training.blas import one_blas_thread
from edp.workflows.executors import Workforce
from edp.workflows.executors.packing import packed, unpacked
from edp.workflows.executors.units import UnitResult, WorkUnit, forget_units, run_units
from edp.workflows.train_evaluate import evaluate, trained_run

UNITS, NETWORK = "units", "network"


def evaluate_with(
    workforce: Workforce,
    run: str | Path,
    source: DataSource | None = None,
    baselines: Sequence[str] | None = None,
    on_step: Callable[[str], None] | None = None,
) -> Path:
    """As `edp.workflows.train_evaluate.evaluate`, by a workforce: models run side by side.

    Args:
        workforce: who runs them; nodes see run and recordings under the same paths.
        run: run folder; what was measured stays in it until the scores are written.
        source: other recordings.
        baselines: names; None takes those of the settings.
        on_step: called with a sentence when a model is done.

    Returns:
        The folder with ``scores.json``.

    Raises:
        EdpError: as `evaluate`; `UnitError` where a model fails.
    """
    folder = Path(run)

    def judged(spec: JudgeSpec, digest: str) -> dict[str, JudgedModel]:
        # Costly ones first, so that none of them begins last.
        names = [*reversed(by_effort(spec.baselines)), NETWORK]
        units = [_unit(name, spec, digest, folder, source) for name in names]

        def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
            if on_step is not None:
                on_step(f"{unit.arguments['model']}, {done} of {len(units)}")

        results = run_units(units, workforce, folder / UNITS, note)
        models = {
            name: unpacked(result.content or b"", JudgedModel) for name, result in zip(names, results, strict=True)
        }
        return {name: models[name] for name in [NETWORK, *by_effort(spec.baselines)]}

    scored = evaluate(folder, source, baselines, judged_by=judged)
    forget_units(folder / UNITS)
    return scored


def _unit(name: str, spec: JudgeSpec, digest: str, folder: Path, source: DataSource | None) -> WorkUnit:
    where = {"run": str(folder.resolve()), "source": None if source is None else source.to_plain()}
    return WorkUnit(
        f"{__name__}:judge_model", f"model '{name}'", {"model": name, "judge": plain_tree(spec)}, digest, where
    )


@one_blas_thread()
def judge_model(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState:
    """Scores of one model of a run, and what pictures show of it."""
    name = identity.config["model"]
    bundle, provenance_seconds, data = _loaded(where["run"], identity.data)
    if where["source"] is not None:
        recordings = DataSource.from_plain(where["source"]).read()
        data = replace(data, test=[bundle.task.series(recording) for recording in recordings])
    spec = build(JudgeSpec, identity.config["judge"], "of the unit")
    bench = ModelBench(bundle.predictor, data, spec)
    if name == NETWORK:
        model = bench.network(describe(bundle.predictor.spec), provenance_seconds)
    else:
        model = bench.baseline(name)
    return WithState({"model": name}, packed(model))


@lru_cache(maxsize=1)
def _loaded(run: str, digest: str) -> tuple[Bundle, float, Prepared]:
    """A run with its data, once for all models that a process runs."""
    bundle, _, provenance, data = trained_run(Path(run))
    return bundle, float(provenance["seconds"]), data
