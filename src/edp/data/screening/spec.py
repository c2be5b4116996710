"""Settings of a screening: targets, horizon, largest lag, sample sizes, thresholds."""

from __future__ import annotations

from dataclasses import dataclass, field

from edp.errors import ConfigError
from edp.settings.bounds import MAX_NAMES, SEED, above, between, check_bounds, check_count, integer

# Rows that estimates rest on: errors of information and rank estimates fall with their root, and time grows at least
# in proportion (of nearest neighbours, ranks and trees); a million is far beyond what any of them gains from.
MAX_SAMPLES = 1_000_000
MAX_TREES = 10_000
MAX_REPEATS = 1_000
MAX_PIECES = 10_000
MAX_NEIGHBOURS = 100
# A minute and a half at 100 Hz, to both sides, for each pair of channels and target.
MAX_LAG = 10_000


@dataclass(frozen=True, kw_only=True)
class ForestSpec:
    """The random forest whose permutation importance is measured on held-out recordings.

    Attributes:
        trees: number of trees.
        samples: rows that it is fitted on, evenly spread over the training recordings.
        test_samples: held-out rows on which channels are permuted.
        repeats: permutations of each group.
        min_samples_leaf: least number of rows in a leaf.
        max_features: share of the channels that a node may choose from.
        test_fraction: share of the recordings (or segments) held out.
    """

    trees: int = 30
    samples: int = 12_000
    test_samples: int = 6_000
    repeats: int = 5
    min_samples_leaf: int = 5
    max_features: float = 1 / 3
    test_fraction: float = 0.34

    def __post_init__(self) -> None:
        check_bounds(
            "screening.forest",
            self,
            trees=integer(1, MAX_TREES),
            samples=integer(1, MAX_SAMPLES),
            test_samples=integer(1, MAX_SAMPLES),
            repeats=integer(1, MAX_REPEATS),
            min_samples_leaf=integer(1, MAX_SAMPLES),
            max_features=above(0.0, 1.0),
            test_fraction=above(0.0, 0.8),
        )


@dataclass(frozen=True, kw_only=True)
class ScreeningSpec:
    """Options of a screening; lags and horizons are samples.

    Attributes:
        targets: channels to be predicted; empty takes the cylinder velocities of Table A.1, else every velocity.
        candidates: channels to evaluate; empty takes all of the recordings. Targets are always among them.
        measured: channels known to be measured on the machine, in addition to the targets and the names of Table A.1.
            Of a channel and its copy, the trusted one is taken for the original.
        horizon: prediction horizon of the model.
        max_lag: lags from -max_lag to max_lag are searched.
        min_segments: least number of segments to compare; recordings are cut where there are fewer.
        neighbours: k of the nearest-neighbour estimate of mutual information.
        information_samples: rows for that estimate, evenly spread over the data.
        rank_samples: number of samples for Kendall's tau.
        segment_samples: rows of each piece for the metrics that are compared among segments.
        collinearity_threshold: rank correlation from which channels form a cluster.
        copy_threshold: correlation at the best lag from which one channel is a copy of another.
        significance_level: chance of a false alarm of each test of significance, shared among the channels.
        forest: the forest.
        seed: seed of all random values.
    """

    targets: tuple[str, ...] = ()
    candidates: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    horizon: int = 10
    max_lag: int = 100
    min_segments: int = 8
    neighbours: int = 3
    information_samples: int = 4_000
    rank_samples: int = 20_000
    segment_samples: int = 1_000
    collinearity_threshold: float = 0.9
    copy_threshold: float = 0.99
    significance_level: float = 0.01
    forest: ForestSpec = field(default_factory=ForestSpec)
    seed: int = 0

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("collinearity_threshold", "copy_threshold", "significance_level"), between(0.0, 1.0))
        rows = dict.fromkeys(("information_samples", "rank_samples", "segment_samples"), integer(100, MAX_SAMPLES))
        check_bounds(
            "screening",
            self,
            horizon=integer(0, MAX_LAG),
            max_lag=integer(20, MAX_LAG),
            min_segments=integer(4, MAX_PIECES),
            neighbours=integer(1, MAX_NEIGHBOURS),
            seed=SEED,
            **rows,
            **shares,
        )
        for name in ("targets", "candidates", "measured"):
            check_count("screening", name, getattr(self, name), MAX_NAMES)
        if self.horizon > self.max_lag:
            raise ConfigError(
                f"screening.horizon = {self.horizon} is beyond max_lag = {self.max_lag}; raise max_lag to see it"
            )
