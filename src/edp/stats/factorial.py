"""Two-level screening designs of resolution IV, with modules that exclude each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from edp.errors import ConfigError, closest
from edp.stats.checks import Array, Mask

MAX_RUNS = 256
"""Maximum number of training runs of a screening. The search for columns grows with the third power of the number of
factors."""
INTERACTION = 0.03
"""Assumed fraction of a run's variance per interaction, to weigh errors against aliases."""
PASSES = 12
"""Maximum number of rounds of coordinate exchange. A design of 14 factors in 32 runs converges in fewer rounds."""


@dataclass(frozen=True, eq=False)
class Factorial:
    """Two-level factorial design: the factors that are on in each run.

    Attributes:
        factors: names.
        levels: ``(run, factor)``, True where on.
        exclusive: groups of factors of which at most one is on.
        alias: largest fraction of a two-factor interaction that adds to a main effect; 0 in resolution IV. Main effects
            are averages over the other factors at the rates of the design.
        error: the largest standard error of a main effect (on minus off) over the noise of one run.
    """

    factors: tuple[str, ...]
    levels: Mask
    exclusive: tuple[tuple[str, ...], ...]
    alias: float
    error: float


def two_level_design(
    factors: Sequence[str], runs: int | None = None, exclusive: Sequence[Sequence[str]] = ()
) -> Factorial:
    """Return a design in which no main effect is aliased with a two-factor interaction.

    In N = 2^m runs the columns are products of an odd number of basic ones (the even ones left out, as in a
    fold-over), so a product of two columns is never a third: resolution IV, for up to N / 2 factors. The selected
    columns have the fewest aliases between interactions.

    If factors exclude each other, such a design does not exist. Conflicting levels are then removed, and levels are
    exchanged one at a time while this lowers the errors and aliases of the main effects; `alias` and `error` contain
    the remaining ones.

    Args:
        factors: names, at least two.
        runs: a power of two, at least twice the factors; None: the smallest.
        exclusive: groups of names of which a network can have only one.

    Raises:
        ConfigError: runs too few or not a power of two, names twice or unknown.
    """
    names = tuple(factors)
    groups = tuple(tuple(group) for group in exclusive)
    run_count = _check_runs(names, runs)
    for group in groups:
        for name in group:
            if name not in names:
                raise ConfigError(f"exclusive factor '{name}' is not among the factors{closest(name, names)}")
        if len(set(group)) != len(group) or len(group) < 2:
            raise ConfigError(f"exclusive group {list(group)} needs at least two different factors")
    levels = _regular(len(names), run_count)
    if groups:
        indices = [tuple(names.index(name) for name in group) for group in groups]
        levels = _exchange_levels(_repair_runs(levels, indices), indices)
        _, alias, error = _quality(levels, indices)
    else:
        _, alias, error = _quality(levels, [])
    return Factorial(names, levels, groups, float(alias), float(error))


def least_runs(factors: int) -> int:
    """Return the smallest power of two for which a design of resolution IV holds the given number of factors."""
    # Resolution IV in N runs takes at most N / 2 factors.
    return max(4, 1 << (2 * factors - 1).bit_length())


def _check_runs(names: tuple[str, ...], runs: int | None) -> int:
    if len(names) < 2 or len(set(names)) != len(names):
        raise ConfigError(f"factors {list(names)} came; give at least two, each once")
    least = least_runs(len(names))
    if least > MAX_RUNS:
        raise ConfigError(f"{len(names)} factors need {least} runs; screen at most {MAX_RUNS // 2} at a time")
    if runs is None:
        return least
    if runs < least or runs > MAX_RUNS or runs & (runs - 1):
        raise ConfigError(
            f"{runs} runs came for {len(names)} factors; resolution IV needs a power of two from {least} to {MAX_RUNS}"
        )
    return runs


def _regular(factors: int, runs: int) -> Mask:
    """Return the columns of odd weight; greedily the one that adds the fewest words of four letters."""
    words = [word for word in range(1, runs) if word.bit_count() % 2]
    basic = [1 << bit for bit in range(runs.bit_length() - 1)]
    chosen = basic[:factors]
    while len(chosen) < factors:
        triples = [a ^ b ^ c for a, b, c in combinations(chosen, 3)]
        free = [word for word in words if word not in chosen]
        # Ties go to the longer word and then to the smaller number, so that a design is the same everywhere.
        chosen.append(min(free, key=lambda word: (triples.count(word), -word.bit_count(), word)))
    return np.array([[(run & word).bit_count() % 2 == 1 for word in chosen] for run in range(runs)], dtype=bool)


def _repair_runs(levels: Mask, groups: Sequence[tuple[int, ...]]) -> Mask:
    """Repair runs with several active factors of a group: select the factor with the fewest selections."""
    fixed = levels.copy()
    for group in groups:
        repairs = dict.fromkeys(group, 0)
        for row in fixed:
            on = [factor for factor in group if row[factor]]
            if len(on) > 1:
                stays = min(on, key=lambda factor: (repairs[factor], factor))
                repairs[stays] += 1
                row[[factor for factor in on if factor != stays]] = False
    return fixed


def _exchange_levels(levels: Mask, groups: Sequence[tuple[int, ...]]) -> Mask:
    """Flip a level of a run, or move it within a group, until the cost no longer decreases."""
    best, cost = levels.copy(), float(_quality(levels, groups)[0])
    moves: list[tuple[int, ...]] = [(factor,) for factor in range(levels.shape[1])]
    moves += sorted(pair for group in groups for pair in combinations(group, 2))
    for _ in range(PASSES):
        before = cost
        for run in range(levels.shape[0]):
            trials = np.repeat(best[None], len(moves), axis=0)
            for trial, move in zip(trials, moves):
                trial[run, list(move)] ^= True
            counts = np.stack([trials[:, run, list(group)].sum(axis=1) for group in groups])
            trials = trials[(counts <= 1).all(axis=0)]
            costs = _quality(trials, groups)[0]
            cheapest = int(np.argmin(costs))
            # A gain below rounding would alternate between two equal designs for ever.
            if costs[cheapest] < cost - 1e-9:
                best, cost = trials[cheapest], float(costs[cheapest])
        if cost == before:
            break
    return best


def _quality(levels: Mask, groups: Sequence[tuple[int, ...]]) -> tuple[Array, Array, Array]:
    """Return the exchange cost, the largest alias and the largest effect error of designs ``(..., run, factor)``.

    The cost is the mean squared error of a main effect when every interaction has `INTERACTION` times a run's variance.
    """
    factors = levels.shape[-1]
    signs = np.where(levels, 1.0, -1.0)
    design = np.concatenate([np.ones((*levels.shape[:-1], 1)), signs], axis=-1)
    moments = design.swapaxes(-1, -2) @ design
    barred = {pair for group in groups for pair in combinations(sorted(group), 2)}
    pairs = [pair for pair in combinations(range(factors), 2) if pair not in barred]
    first, second = (np.array([pair[side] for pair in pairs], dtype=int) for side in (0, 1))
    rest = signs - signs.mean(axis=-2, keepdims=True)
    # The small addition keeps a singular design from stopping the others; its errors are then beyond any bound.
    inverse = np.linalg.inv(moments + 1e-9 * np.eye(factors + 1))
    errors = 4.0 * np.diagonal(inverse, axis1=-2, axis2=-1)[..., 1:]
    alias = (inverse @ (design.swapaxes(-1, -2) @ (rest[..., first] * rest[..., second])))[..., 1:, :]
    # Remove the effect of the small addition above in designs without aliases.
    alias = np.where(np.abs(alias) < 1e-8, 0.0, alias)
    cost = errors.mean(axis=-1) + 4.0 * INTERACTION * np.square(alias).sum(axis=-1).mean(axis=-1)
    cost = np.where((errors > 0.0).all(axis=-1) & (errors < 1e6).all(axis=-1), cost, np.inf)
    return cost, np.abs(alias).max(axis=(-2, -1), initial=0.0), np.sqrt(np.abs(errors).max(axis=-1))
