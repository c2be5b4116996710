"""Settings of an ensemble whose networks have different training folds."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import ConfigError
from edp.networks.trees import MAX_DEPTH
from edp.settings.bounds import MAX_BATCH, MAX_EPOCHS, MAX_ROWS, MAX_WEIGHT, above, check_bounds, integer, span

MAX_FOLDS = 100
MAX_TREE_MODELS = 3
MAX_RATE = 1.0


@dataclass(frozen=True, kw_only=True)
class BaggingSpec:
    """Train the members of a committee on folds of the training and validation parts together.

    Attributes:
        folds: contiguous folds; each member leaves one out, stops where its error there is least, and so do the
            members together tell the error to expect. A committee's members are dealt out evenly.
        steps: updates of each member.
        batch: rows of each update.
        learning_rate: largest one, of AdamW; it rises over a tenth of the steps and falls as a cosine.
        weight_decay: weight decay of AdamW.
        huber_delta: every second member of a fold is trained with the Huber loss of this threshold, in spreads of
            what the linear model leaves, instead of `training.loss`; 0 for none.
        validations: number of comparisons of the members on their left-out rows.
        max_rows: rows that train at most, evenly spread over longer recordings.
        tree_learning_rate: share of each boosted tree's leaves that is added.
        tree_min_leaf_rows: rows of a leaf at least.
        tree_max_leaves: leaves of a tree at most, the ones that lower the error most; 0 for as many as the depth
            allows.
        tree_models: models of each output that share its trees: of what the linear model leaves, of the target by few
            columns (present values and changes over powers of two ticks), of the target by all columns.
        tree_folds: parts that trees leave out, each a run of neighbouring folds; fewer parts than `folds` take less
            time, for trees are grown again for each.
        tree_max_rows: rows that trees are grown on at most, drawn at random.

    Raises:
        ConfigError: a value out of range.
    """

    folds: int = 5
    steps: int = 1500
    batch: int = 256
    learning_rate: float = 3e-3
    weight_decay: float = 1e-2
    huber_delta: float = 0.0
    validations: int = 15
    max_rows: int = 200_000
    # A tenth and twenty rows are scikit-learn's; twice the rate with fewer trees was no better on four measured sets.
    tree_learning_rate: float = 0.1
    tree_min_leaf_rows: int = 20
    tree_max_leaves: int = 31  # scikit-learn's
    tree_models: int = 3
    tree_folds: int = 5
    tree_max_rows: int = 30_000

    def __post_init__(self) -> None:
        check_bounds(
            "training.ensemble",
            self,
            folds=integer(2, MAX_FOLDS),
            steps=integer(1, MAX_EPOCHS),
            batch=integer(1, MAX_BATCH),
            learning_rate=above(0.0, MAX_RATE),
            weight_decay=span(0.0, MAX_WEIGHT),
            huber_delta=span(0.0, MAX_WEIGHT),
            validations=integer(1, MAX_EPOCHS),
            max_rows=integer(100, MAX_ROWS),
            tree_learning_rate=above(0.0, MAX_RATE),
            tree_min_leaf_rows=integer(1, MAX_ROWS),
            tree_max_leaves=integer(0, 2**MAX_DEPTH),
            tree_models=integer(1, MAX_TREE_MODELS),
            tree_folds=integer(2, MAX_FOLDS),
            tree_max_rows=integer(100, MAX_ROWS),
        )
        if self.tree_max_leaves == 1:
            raise ConfigError(
                "training.ensemble: tree_max_leaves = 1, but a tree of one leaf splits nothing; 2 or more must hold, "
                "or 0 for as many as the depth allows"
            )
