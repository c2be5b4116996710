"""Uncertainty of fitted parameters from the differences between parts of the logs and free-run lengths.

The information of a fit takes its errors for noise that is new at each tick. They are not: neighbouring ticks err
alike, and so does a structure that is not the machine's, in every run of a length. So at the optimum each block of the
logs and each length of the free runs says where it would go (one Gauss-Newton step), and the covariance is a sum::

    A (sum_b g_b g_b') A + A + d d' / 4 + mean_l (e_l e_l')

A is the inverse information with what was plausible before, g_b the gradient of block b about their mean (White, 1982,
by clusters), d the difference of what two halves of the logs say, and e_l where free runs of length l alone would go. A
structure that is wrong fits short and long runs by different numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.networks.twin.greybox import GreyTwin
from edp.networks.twin.parameters import Parametrisation
from edp.training.blas import one_blas_thread
from edp.training.grey_fit import GreyProblem

Doubles = NDArray[np.float64]
MIN_BLOCKS, MAX_BLOCKS = 6, 16
"""Blocks of the logs: a spread over fewer says little, and more of them take time."""
LENGTHS = 3
"""Of the fit's last stages, from which free runs are drawn."""
TICKS = 3000
"""Of the free runs of a block and a length, about; a third of a second of a desktop core."""


@one_blas_thread()
def covariance(
    twin: GreyTwin, parametrisation: Parametrisation, theta: Doubles, train: Sequence[Series], seed: int
) -> Doubles:
    """Return the covariance of the fitted coordinates; the prior's if the logs are too short to be divided.

    Args:
        twin: the grey box at the optimum.
        parametrisation: the coordinates.
        theta: the optimum, in plausible deviations ``(coordinate,)``.
        train: segments that the fit has learned from.
        seed: seed of the free runs.
    """
    rate, prefix = twin.channels.rate_hz, twin.prefix_ticks
    lengths = sorted({max(1, round(length * rate)) for length in twin.spec.fit.lengths_s[-LENGTHS:]})
    blocks = divided(train, prefix + lengths[-1] + 1)
    size = len(theta)
    if len(blocks) < 2:
        return np.eye(size)
    rng, shape = np.random.default_rng(seed), (len(lengths), len(blocks), size)
    matrices, gradients = np.zeros((len(lengths), 2, size, size)), np.zeros(shape)
    for b, block in enumerate(blocks):
        problem = GreyProblem(twin, block, parametrisation)
        for k, ticks in enumerate(lengths):
            drawn = problem.draw(ticks, max(4, min(TICKS, twin.spec.fit.ticks) // ticks), rng)
            equations = problem.normal_equations(theta, drawn, True)
            gradients[k, b] = equations.gradient
            matrices[k, b % 2] += equations.matrix
    return spread(theta, matrices, gradients)


def spread(theta: Doubles, matrices: Doubles, gradients: Doubles) -> Doubles:
    """Return the sum of the four parts described above.

    Args:
        theta: the optimum ``(coordinate,)``.
        matrices: matrices by length and by half of the blocks, even and odd ``(length, 2, coordinate, coordinate)``.
        gradients: gradients by length and by block ``(length, block, coordinate)``.
    """
    lengths, blocks, size = gradients.shape
    prior = np.eye(size)

    def moved(matrix: Doubles, gradient: Doubles, share: float) -> Doubles:
        # Scale the information of a part of the logs to the amount of information in all logs.
        return np.asarray(np.linalg.solve(matrix / share + prior, gradient / share + theta))

    inverse = np.linalg.inv(matrices.sum(axis=(0, 1)) + prior)
    by_block = gradients.sum(axis=0)
    centred = by_block - by_block.mean(axis=0)
    sandwich = inverse @ (centred.T @ centred) @ inverse * blocks / (blocks - 1)
    halves = [
        moved(matrices[:, h].sum(axis=0), by_block[h::2].sum(axis=0), len(by_block[h::2]) / blocks) for h in range(2)
    ]
    apart = halves[0] - halves[1]
    each = np.array([moved(matrices[k].sum(axis=0), gradients[k].sum(axis=0), 1.0 / lengths) for k in range(lengths)])
    return np.asarray(sandwich + inverse + np.outer(apart, apart) / 4.0 + each.T @ each / lengths)


def divided(train: Sequence[Series], least: int) -> list[list[Series]]:
    """Divide segments into `MIN_BLOCKS` to `MAX_BLOCKS` groups with at least `least` samples.

    Short logs give fewer.
    """
    usable = [part for part in train if part.samples >= least]
    pieces = [piece for part in usable for piece in _cut(part, -(-MIN_BLOCKS // len(usable)), least)]
    count = min(len(pieces), MAX_BLOCKS)
    return [pieces[b::count] for b in range(count)]


def _cut(part: Series, pieces: int, least: int) -> list[Series]:
    """Divide a segment into `pieces` parts, or as many as have `least` samples each."""
    count = max(1, min(pieces, part.samples // least))
    edges = np.linspace(0, part.samples, count + 1).astype(int)
    return [
        replace(part, inputs=part.inputs[first:last], targets=part.targets[first:last])
        for first, last in pairwise(edges)
    ]
