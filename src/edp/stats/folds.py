"""Assignment of sessions to evaluation runs: repeated grouped folds, and the thesis's repeated splits."""

from __future__ import annotations

import numpy as np

from edp.errors import ConfigError
from edp.stats.checks import Mask


def repeated_folds(sessions: int, folds: int = 5, repeats: int = 1, seed: int = 0) -> Mask:
    """Return repeated grouped k-fold assignments: each repeat distributes all sessions again, one run per fold.

    The same seed and a larger number of repeats give the same first runs, so a study can be continued.

    Returns:
        ``(run, session)``: mask of the sessions on which each run is evaluated; it trains on the others.

    Raises:
        ConfigError: fewer sessions than folds, fewer than two folds, or no repeat.
    """
    if folds < 2 or repeats < 1:
        raise ConfigError(f"{folds} folds and {repeats} repeats came; use at least 2 folds and 1 repeat")
    if sessions < folds:
        raise ConfigError(f"{sessions} sessions cannot be dealt into {folds} folds; record more or set fewer folds")
    tested = np.zeros((repeats * folds, sessions), dtype=bool)
    for repeat in range(repeats):
        # The fold of extra sessions moves with the repeat, so that no fold is always the larger one.
        order = np.random.default_rng([seed, repeat]).permutation(sessions)
        for index, session in enumerate(order):
            tested[repeat * folds + (index + repeat) % folds, session] = True
    return tested


def repeated_splits(sessions: int, test_sessions: int, splits: int, seed: int = 0) -> Mask:
    """Return the thesis's design: `splits` independent random draws of the test sessions.

    Returns:
        ``(split, session)``.

    Raises:
        ConfigError: no session left to train or to evaluate on, or no split.
    """
    if not 0 < test_sessions < sessions or splits < 1:
        raise ConfigError(
            f"{splits} splits with {test_sessions} of {sessions} sessions to judge on came; both parts need a session"
        )
    tested = np.zeros((splits, sessions), dtype=bool)
    for split in range(splits):
        # Each split has its own random stream, so that more splits do not change the first ones.
        rng = np.random.default_rng([seed, split])
        tested[split, rng.choice(sessions, test_sessions, replace=False)] = True
    return tested
