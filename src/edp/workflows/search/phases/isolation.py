"""Phase 0: variance of scores between folds and seeds, and choice of the feature set (thesis 3.3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, count_of
from edp.evaluation.study import Decision
from edp.evaluation.study_facts import ArmComparison, ArmFacts, FeatureComparison, IsolationFacts
from edp.stats.clustered import clustered_t
from edp.stats.paired import fill_worst
from edp.stats.variance import PairedVariance, paired_variance, split_variance, thesis_variance
from edp.wording import behind, percent, percent_interval, typed
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import Array, SearchContext
from edp.workflows.search.phases.base import PHASES, Course, relative_change
from edp.workflows.search.space import CHANNELS, UNITS
from edp.workflows.search.trainings import Outcome

DEFAULT_BACKBONE: dict[str, Mapping[str, object]] = {
    "lstm": {"kind": "lstm", "units": 64},
    "gru": {"kind": "gru", "units": 64},
    "tcn": {"kind": "tcn", "channels": [64, 64, 64, 64], "kernel": 3},
    "hybrid": {"kind": "hybrid", "channels": [64], "kernel": 5, "units": 64},
}


def arm_of(base: Arm, backbone: str, features: str | Mapping[str, object]) -> Arm:
    """Return the base with another backbone of similar size, and another feature set (a name, or a plain table)."""
    arm = base.with_value("task.features", features).with_value("model.blocks", [])
    if base["model.backbone.kind"] == backbone:
        return arm
    arm = arm.with_value("model.backbone", DEFAULT_BACKBONE[backbone])
    # Like width: backbones are compared before any is tuned.
    width = int(base.get(UNITS, (base.get(CHANNELS) or [64])[-1]))
    if UNITS in arm:
        arm = arm.with_value(UNITS, width)
    return arm.with_value(CHANNELS, [width] * len(arm[CHANNELS])) if CHANNELS in arm else arm


class Isolation:
    """Phase 0."""

    title = "isolation and variance"

    def arms(self, context: SearchContext) -> list[tuple[str, str]]:
        """Return the backbone and feature set of each arm."""
        return [(backbone, features) for backbone in context.spec.backbones for features in context.spec.feature_sets]

    def trainings(self, context: SearchContext) -> int:
        """Return all of them at once."""
        return len(self.arms(context)) * context.spec.isolation.runs * context.spec.isolation.seeds

    def run(self, context: SearchContext) -> Course:
        """Return all arms on the same folds with the same seeds, in one batch."""
        spec = context.spec
        outcomes = yield [
            order
            for backbone, features in self.arms(context)
            for seed in range(spec.isolation.seeds)
            for order in context.orders(
                context.shaped(arm_of(context.base, backbone, spec.feature_sets[features])),
                range(spec.isolation.runs),
                seed=seed,
            )
        ]
        return self.decide(context, outcomes)

    def decide(self, context: SearchContext, outcomes: Sequence[Outcome]) -> Decision:
        """Return the variance components of each arm; the feature set with the lowest mean score over all backbones."""
        spec, arms = context.spec, self.arms(context)
        tables = _tables(context, outcomes, len(arms))
        errors = _tables(context, outcomes, len(arms), "mae")
        estimate = thesis_variance if spec.mode == "thesis" else split_variance
        arm_facts = {}
        for (backbone, features), scores, mae in zip(arms, tables, errors, strict=True):
            by_run = np.nanmean(scores, axis=2).T  # (run, seed)
            arm_facts[f"{backbone} {features}"] = ArmFacts(
                **vars(estimate(by_run)),
                by_run=tuple(map(tuple, by_run.tolist())),
                mae=estimate(np.nanmean(mae, axis=2).T),
            )
        # Table 4.3 compares feature sets by their mean absolute error.
        what, judging = ("MAE", errors) if spec.mode == "thesis" else ("composite score", tables)
        means = {
            # Common folds and seeds: feature sets are compared within them.
            features: float(np.mean([np.nanmean(t) for (_, f), t in zip(arms, judging, strict=True) if f == features]))
            for features in spec.feature_sets
        }
        chosen = min(means, key=lambda name: means[name])
        own = {name: arm_table.mean(axis=0) for (name, f), arm_table in zip(arms, tables, strict=True) if f == chosen}
        facts = IsolationFacts(
            arms=arm_facts,
            runs=spec.isolation.runs,
            seeds=spec.isolation.seeds,
            features=chosen,
            mean_scores=means,
            comparisons=self._comparisons(context, tables, chosen),
            backbones=lowest_against_others(own, _mask_sessions(context)[0]),
            variance=_proxy(context, tables, arms),
        )
        sentences = [
            f"Feature set {chosen} goes on: mean {what} "
            + ", ".join(f"{name} {typed(value, 3)}" for name, value in means.items())
            + f"{behind(context.unit)} over all backbones."
        ]
        for backbone, comparison in facts.comparisons.items():
            sentences.append(
                f"{backbone}: {chosen} against {comparison.reference} {percent(comparison.change, signed=True)} "
                f"(one-sided p {typed(comparison.p, 2)}, two-way clustered t over "
                f"{count_of(spec.isolation.runs, 'run')})."
            )
        for backbone, against in facts.backbones.items():
            sentences.append(
                f"With {chosen}, {against.best} against {backbone} {percent(against.change, signed=True)} "
                f"({percent_interval(against.low, against.high)}); phase 1 tunes each before one is chosen."
            )
        return Decision("isolation", facts, tuple(sentences))

    def _comparisons(self, context: SearchContext, tables: list[Array], chosen: str) -> dict[str, FeatureComparison]:
        """Compare the chosen feature set with the next best one, for each backbone."""
        spec = context.spec
        references = [name for name in spec.feature_sets if name != chosen]
        comparisons = {}
        for index, backbone in enumerate(spec.backbones):
            own = {f: tables[index * len(spec.features) + i] for i, f in enumerate(spec.feature_sets)}
            if not references:
                continue
            reference = min(references, key=lambda name: float(np.nanmean(own[name])))
            first, second = (own[name].mean(axis=0) for name in (chosen, reference))
            mask, _ = _mask_sessions(context)
            test = clustered_t(np.where(mask, first - second, 0.0), mask)
            change = relative_change(test, float(np.nanmean(second)))
            comparisons[backbone] = FeatureComparison(**vars(change), reference=reference)
        return comparisons


def lowest_against_others(tables: Mapping[str, Array], mask: NDArray[np.bool_]) -> dict[str, ArmComparison]:
    """Compare the arm with the lowest mean score with each of the others.

    Args:
        tables: scores ``(run, session)`` by the name of the arm.
        mask: cells that are evaluated.
    """
    means = {name: float(arm_table[mask].mean()) for name, arm_table in tables.items()}
    best = min(means, key=lambda name: means[name])
    comparisons = {}
    for name, arm_table in tables.items():
        if name != best:
            test = clustered_t(np.where(mask, tables[best] - arm_table, 0.0), mask)
            comparisons[name] = ArmComparison(**vars(relative_change(test, means[name])), best=best)
    return comparisons


def _tables(context: SearchContext, outcomes: Sequence[Outcome], arms: int, name: str = "composite") -> list[Array]:
    """Return the scores of each arm ``(seed, run, session)``; failed trainings count as the worst of all arms."""
    spec = context.spec
    size = spec.isolation.runs
    mask, seen = _mask_sessions(context)
    raw = np.stack([context.table(outcomes[at : at + size], name)[:, seen] for at in range(0, len(outcomes), size)])
    filled = fill_worst(raw, mask)
    # Cells that no run judges are no scores.
    filled[:, ~mask] = np.nan
    return list(filled.reshape(arms, spec.isolation.seeds, size, -1))


def _mask_sessions(context: SearchContext) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return a mask ``(run, session)`` of the sessions that some run evaluates, and those sessions."""
    mask = context.folds(context.spec.isolation.runs)
    seen = np.asarray(mask.any(axis=0))
    return mask[:, seen], seen


def _proxy(context: SearchContext, tables: list[Array], arms: list[tuple[str, str]]) -> PairedVariance:
    """Return the variance of paired differences that planning assumes for a module's effect.

    Before a module was ever trained the variance of its effect is not known. That between the feature sets of one
    backbone stands in for it; with one feature set, that between backbones, and with one arm, that between seeds. The
    largest of them counts.
    """
    mask, _ = _mask_sessions(context)
    pairs = [(i, j) for i in range(len(arms)) for j in range(i + 1, len(arms))]
    # Pairs of the same backbone show what a feature set changes; other pairs only where there are none.
    alike = [(i, j) for i, j in pairs if arms[i][0] == arms[j][0]] or pairs
    differences = [tables[i][0] - tables[j][0] for i, j in alike] or [tables[0][0] - own for own in tables[0][1:]]
    if not differences:
        raise DataError(
            "one backbone, one feature set and one seed show no variance; set search.isolation.seeds = 2 or more"
        )
    variances = [paired_variance(np.where(mask, difference, 0.0), mask) for difference in differences]
    # The largest variance: planning should not promise too much.
    return max(variances, key=lambda variance: variance.session + variance.run + variance.cell)


PHASES.register("isolation")(Isolation())
