"""How often does each procedure confirm a module that does nothing, and how often one that helps?

Every study has 14 modules. Under the exact null each is the baseline with other random numbers: its true effect, over
all sessions that might have been recorded, is zero. The thesis's design is 10 random splits of 5 test sessions with 3
seeds; ours is up to 6 repeats of 5 grouped folds with a race. Both cost at most 30 trainings of each arm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from common import Verdict, finish, parser, table, verdict
from edp.stats import (
    Rule,
    benjamini_hochberg,
    clustered_t,
    confirm,
    paired_t,
    repeated_folds,
    repeated_splits,
    resampled_t,
    run_means,
    thesis_confirm,
)
from edp.stats.metrics import COMPOSITE_WEIGHTS
from score_worlds import METRICS, STRESS, WORLDS, Array, Mask, Source

ALPHA = 0.05
SPLITS, SEEDS, HELD_OUT = 10, 3, 5
FOLDS, REPEATS = 5, 6
EFFECTS = (-0.01, -0.02, -0.03, -0.04)
THESIS, SOUND, OVERLAP = "thesis: mixed model z, any of 4", "sound", "Nadeau-Bengio t, one metric"
BARE = "sound, no practical gate"


@dataclass(frozen=True)
class Outcome:
    """What a procedure said in one study.

    Attributes:
        confirmed: by module.
        significant: whether p is below the level before any adjustment; modules first.
        trainings: that the study took, the baseline's among them.
    """

    confirmed: NDArray[np.bool_]
    significant: NDArray[np.bool_]
    trainings: int


Way: TypeAlias = Callable[[Source, Array, int], dict[str, Outcome]]


@dataclass(frozen=True)
class Rates:
    """What a procedure did over many studies.

    Attributes:
        significant: share of the null modules' tests with p below the level, not adjusted.
        false: share of the null modules that it confirmed.
        any_false: share of the studies with at least one of them.
        found: share of the studies in which it confirmed the first module, the one with an effect.
        trainings: mean number of trainings of a study.
        studies: how many.
    """

    significant: float
    false: float
    any_false: float
    found: float
    trainings: float
    studies: int


def composite(scores: Array) -> Array:
    """Primary metric of each cell: the composite of the four, eq. 3.41."""
    weights = np.array([COMPOSITE_WEIGHTS[name] for name in METRICS])
    return np.asarray(np.tensordot(weights, scores, axes=1))


def thesis_design(source: Source, repetition: int) -> tuple[Mask, NDArray[np.int64]]:
    """Cells and splits of the thesis's runs."""
    splits = np.repeat(np.arange(SPLITS), SEEDS)
    return repeated_splits(source.sessions, HELD_OUT, SPLITS, drawn_as(source, repetition))[splits], splits


def drawn_as(source: Source, repetition: int) -> int:
    """Number of the folds of a study; where scores are trained, studies share folds, as trainings are dear."""
    return repetition % source.designs if source.designs else repetition


def thesis_studies(source: Source, effects: Array, repetition: int) -> dict[str, Outcome]:
    """One study in the thesis's design, judged by its own rule and by three single tests of one metric."""
    tested, splits = thesis_design(source, repetition)
    scores = source.scores(tested, splits, effects, repetition)
    names = [str(i) for i in range(source.modules)]
    by_split = run_means(scores, tested).reshape(len(METRICS), -1, SPLITS, SEEDS)
    judged = thesis_confirm(by_split, names, METRICS, ALPHA)
    raw = np.array([one.p < ALPHA for one in judged]).reshape(-1, len(METRICS))
    cost = len(splits) * (1 + source.modules)
    found = {THESIS: Outcome(np.array([one.confirmed for one in judged[:: len(METRICS)]]), raw, cost)}
    single = composite(scores)
    differences = single[1:] - single[0]
    means = run_means(differences, tested).reshape(-1, SPLITS, SEEDS).mean(axis=-1)
    tests = {
        "paired t, one metric": paired_t(means).p,
        OVERLAP: resampled_t(means, HELD_OUT / (source.sessions - HELD_OUT)).p,
        "clustered t, one metric": clustered_t(differences, tested).p,
    }
    return found | {name: Outcome(benjamini_hochberg(p) < ALPHA, p < ALPHA, cost) for name, p in tests.items()}


def sound_studies(source: Source, effects: Array, repetition: int) -> dict[str, Outcome]:
    """One study in our design: the whole decision, and the same without the practical gate."""
    tested = repeated_folds(source.sessions, FOLDS, REPEATS, drawn_as(source, repetition))
    scores = composite(source.scores(tested, np.arange(len(tested)), effects, repetition))
    names = [str(i) for i in range(source.modules)]
    found = confirm(scores, names, names, tested, Rule(alpha=ALPHA))
    cost = len(tested) + sum(one.runs for one in found)
    raw = np.array([one.p < ALPHA for one in found])
    return {
        SOUND: Outcome(np.array([one.confirmed for one in found]), raw, cost),
        BARE: Outcome(np.array([one.adjusted < ALPHA for one in found]), raw, cost),
    }


def rates(
    source: Source, effect: float, studies: int, seed: int = 0, ways: Sequence[Way] = (thesis_studies, sound_studies)
) -> dict[str, Rates]:
    """Rates of all procedures over many studies in which only the first module has an effect."""
    effects = np.r_[effect, np.zeros(source.modules - 1)]
    null = effects == 0.0
    seen: dict[str, list[Outcome]] = {}
    for repetition in range(studies):
        for way in ways:
            for name, outcome in way(source, effects, 1_000_000 * seed + repetition).items():
                seen.setdefault(name, []).append(outcome)
    found = {}
    for name, outcomes in seen.items():
        confirmed = np.array([one.confirmed for one in outcomes])
        wrong = confirmed[:, null]
        found[name] = Rates(
            significant=float(np.mean([one.significant[null].mean() for one in outcomes])),
            false=float(wrong.mean()),
            any_false=float(wrong.any(axis=1).mean()),
            found=float(confirmed[:, 0].mean()),
            trainings=float(np.mean([one.trainings for one in outcomes])),
            studies=len(outcomes),
        )
    return found


def null_table(
    sources: Sequence[Source], studies: int, seed: int, ways: Sequence[Way] = (thesis_studies, sound_studies)
) -> dict[str, dict[str, Rates]]:
    """Rates under the exact null, printed."""
    found = {source.name: rates(source, 0.0, studies, seed, ways) for source in sources}
    print(f"exact null, {studies} studies of {sources[0].modules} modules, level {ALPHA}")
    rows = [
        [world, name, one.significant, one.false, one.any_false, deviation(one.any_false, studies), one.trainings]
        for world, ways in found.items()
        for name, one in ways.items()
    ]
    table(["world", "procedure", "p < 0.05", "confirmed", "any of 14", "+/-", "trainings"], rows)
    return found


def deviation(share: float, studies: int) -> float:
    """Standard error of a share."""
    return float(np.sqrt(share * (1.0 - share) / studies))


def power_table(sources: Sequence[Source], studies: int, seed: int) -> list[list[object]]:
    """Power with one true module among null ones, printed."""
    print(f"\none module of 14 has an effect, {studies} studies: share of them that confirm it; trainings of ours")
    rows: list[list[object]] = []
    for source in sources:
        for effect in EFFECTS:
            found = rates(source, effect, studies, seed + 1)
            powers = (found[name].found for name in (SOUND, OVERLAP, THESIS))
            rows.append([source.name, f"{100 * effect:+.0f} %", *powers, found[SOUND].trainings])
    table(["world", "effect", SOUND, OVERLAP, THESIS, "trainings"], rows)
    return rows


def main() -> None:
    """Print both tables and the verdicts."""
    arguments = parser(__doc__ or "").parse_args()
    studies, powered = (50, 15) if arguments.quick else (1000, 200)
    worlds: list[Source] = list(WORLDS.values())
    found = null_table([*worlds, STRESS], studies, arguments.seed)
    curve = power_table(worlds, powered, arguments.seed)
    print()
    for world, ways in found.items():
        print(f"{world}: any false module, sound {ways[SOUND].any_false:.3f}, thesis {ways[THESIS].any_false:.3f}")
    print("the last world breaks what every test of these splits assumes; its rates are shown, not judged")
    verdicts: list[Verdict] = [
        verdict(
            f"any false module of 14, {world.name}",
            found[world.name][BARE].any_false,
            ALPHA,
            "<= 1",
            "share",
            arguments.quick,
        )
        for world in worlds
    ]
    plain = {world: {name: vars(one) for name, one in ways.items()} for world, ways in found.items()}
    finish("null_calibration", verdicts, arguments.seed, {"null": plain, "power": curve})


if __name__ == "__main__":
    main()
