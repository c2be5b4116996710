"""Golden recordings of a network: random inputs, outputs of PyTorch, and the tolerance for other forms."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray

from edp.ir import Graph
from edp.ir.layers import NEVER
from edp.ir.memory import Feed
from edp.ir.reference import Reference
from edp.networks.input_range import usual_range
from edp.networks.integer import IntegerPredictor
from edp.networks.predictor import Predictor
from edp.networks.trees import Trees

if TYPE_CHECKING:
    from edp.networks.twin import TwinPlant

GOLDEN_TICKS = 200
SHARE = 1e-5
"""Tolerance between an exported model and PyTorch, in standard deviations of the target and relative to the value."""
DISTURBED, ROUNDED = 3, 2.0**-23
"""Number of disturbed plant simulations, and disturbance of their feedback in standard deviations: float32 rounding."""
NEAR = 1e-5
"""Distance from a tree threshold within which results may differ, in standard deviations and relative to the value."""
MOVES = 12
"""Number of random perturbations of all thresholds, because rounding may change the result of several nodes."""
TRIES, NEAR_GOLDEN = 20, 1e-6
"""Maximum number of random recordings, and minimum distance of their values from all tree thresholds."""
Rows = NDArray[np.float32]


def tolerance(predictor: Predictor, inputs: Rows, outputs: Rows) -> Rows:
    """Return the permitted deviation of another form from `outputs` (PyTorch, single precision), for each element.

    `SHARE` of a standard deviation and of the largest value; where PyTorch in single precision is farther than that
    from itself in double precision (a layer norm of a cell near zero), twice that distance. Integers: nothing. Ticks
    `at_thresholds` do not count here.
    """
    if isinstance(predictor, IntegerPredictor):
        return np.zeros(outputs.shape[1], dtype=np.float32)
    if _is_plant(predictor):
        grown: Rows = grown_tolerance(predictor, inputs, outputs).max(axis=0)
        return grown
    exact = stream(copy.deepcopy(predictor).double(), inputs)
    sigma = predictor.code.width.detach().cpu().double().numpy().ravel()
    widths = np.tile(sigma, outputs.shape[1] // len(sigma))
    # Where PyTorch in single precision is itself far from double precision, no other form can be asked for more.
    own = np.where(relax_at_thresholds(predictor, inputs) > 0.0, 0.0, np.abs(outputs - exact)).max(axis=0)
    result: Rows = np.maximum(SHARE * (widths + np.abs(outputs).max(axis=0)), 2.0 * own).astype(np.float32)
    return result


def _is_plant(predictor: Predictor) -> TypeGuard[TwinPlant]:
    # Imported here: training and search import this module, and a plant brings the compiler of grey boxes.
    from edp.networks.twin import TwinPlant

    return isinstance(predictor, TwinPlant)


def grown_tolerance(plant: TwinPlant, inputs: Rows, outputs: Rows) -> Rows:
    """Return the permitted deviation of another form of a plant at each sample, ``(tick, number)``; it never decreases.

    What `tolerance` allows without feedback, plus what comes of it when it is fed back: the largest distance up to the
    tick between the plant in double precision and `DISTURBED` runs of it in which every answer that is fed back is off
    by a normal draw of `ROUNDED` standard deviations; at least twice the distance of the plant in single precision.
    """
    graph, ticks = plant.graph(), len(inputs)
    exact = _compute_with_noise(graph, inputs, None)
    draws = [np.random.default_rng(seed) for seed in range(DISTURBED)]
    apart = np.max([np.abs(_compute_with_noise(graph, inputs, draw) - exact) for draw in draws], axis=0)
    moved = np.maximum.accumulate(np.maximum(apart, 2.0 * np.abs(outputs - exact)), axis=0)
    sigma = plant.code.width.detach().cpu().double().numpy().ravel()
    return np.asarray(SHARE * (sigma + np.abs(outputs).max(axis=0)) + moved[:ticks], dtype=np.float32)


def _compute_with_noise(graph: Graph, inputs: Rows, draw: np.random.Generator | None) -> NDArray[np.float64]:
    """Return outputs in double precision ``(tick, number)``, with noise on the feedback."""
    run = Reference(graph)
    fed_back = [layer.into for layer in graph.layers if isinstance(layer, Feed)]
    rows = []
    for row in inputs:
        rows.append(run.results(row)["prediction"])
        if draw is not None:
            for name in fed_back:
                last = run.memory[name]["last"]
                run.memory[name]["last"] = last + ROUNDED * draw.normal(size=last.shape)
    return np.asarray(rows)


def relax_at_thresholds(predictor: Predictor, inputs: Rows, near: float = NEAR) -> Rows:
    """Return the additional tolerance at samples where rounding decides the branch of a tree.

    Args:
        predictor: the network.
        inputs: ``(tick, input)``, from reset.
        near: possible error of a value near a threshold, in standard deviations and as a fraction.

    Returns:
        ``(tick, number)``: twice the range of the predictions with all thresholds moved by up to so much; zero where
        no number is near one, and for networks without trees or in integers.
    """
    if isinstance(predictor, IntegerPredictor) or not any(isinstance(part, Trees) for part in predictor.modules()):
        return np.zeros((len(inputs), 1), dtype=np.float32)
    draw = torch.Generator().manual_seed(0)
    predictions = []
    for number in range(MOVES):
        moved = copy.deepcopy(predictor)
        for part in moved.modules():
            if isinstance(part, Trees):
                share = torch.rand(part.threshold.shape, generator=draw) * 2.0 - 1.0
                # All to one side as well: trees share thresholds.
                share = share if number > 1 else torch.full_like(share, 2.0 * number - 1.0)
                # What is never exceeded stays so: beyond single precision there is only infinity.
                step = near * share.to(part.threshold) * part.threshold.abs().clamp(min=1.0)
                part.threshold.add_(step).clamp_(-NEVER, NEVER)
        predictions.append(stream(moved, inputs))
    return np.asarray(2.0 * np.ptp(predictions, axis=0), dtype=np.float32)


def golden_recording(predictor: Predictor, ticks: int) -> tuple[Rows, Rows, Rows]:
    """Return the random inputs, what PyTorch streams from them, and how far another form may be from it.

    Returns:
        ``(tick, input)``, ``(tick, number)``, ``(number,)``. No number meets a threshold of a tree where one of
        `TRIES` draws has that; otherwise what is allowed holds the largest step.
    """
    # Fixed seeds: the same network gives the same recording, byte by byte.
    draws = (random_inputs(predictor, ticks, seed) for seed in range(TRIES))
    inputs, steps = min(
        _take_until_clear((drawn, relax_at_thresholds(predictor, drawn, NEAR_GOLDEN)) for drawn in draws),
        key=lambda draw: float(draw[1].max()),
    )
    outputs = stream(predictor, inputs)
    return inputs, outputs, tolerance(predictor, inputs, outputs) + steps.max(axis=0)


def _take_until_clear(draws: Iterable[tuple[Rows, Rows]]) -> Iterator[tuple[Rows, Rows]]:
    """Yield draws until the first draw without a step."""
    for inputs, steps in draws:
        yield inputs, steps
        if not steps.any():
            return


def random_inputs(predictor: Predictor, ticks: int, seed: int, mixed: bool = True) -> Rows:
    """Smooth random inputs ``(tick, input)`` in the usual range of each channel, SI units.

    A plant is measured for its prefix, then runs free; with `mixed` its ports are measured by chance from the middle
    of the rest on.
    """
    rows = _smooth(predictor, ticks, seed)
    if _is_plant(predictor):
        _set_ports(predictor, rows, seed, mixed)
    return rows


def _set_ports(plant: TwinPlant, rows: Rows, seed: int, mixed: bool) -> None:
    """Set the flags of a plant, and zero unread inputs, like a program without sensors."""
    commands, answers, _ = plant.sizes
    flags = np.zeros((len(rows), answers), np.float32)
    flags[: plant.window] = 1.0
    middle = (plant.window + len(rows)) // 2
    if mixed and middle < len(rows):
        draw = np.random.default_rng(seed).random((len(rows) - middle, answers))
        flags[middle:] = draw < 0.5
    rows[:, commands : commands + answers] *= flags
    rows[:, commands + answers :] = flags


def _smooth(predictor: Predictor, ticks: int, seed: int) -> Rows:
    centre, spread = usual_range(predictor)
    # A private generator: an export draws nothing from the caller's.
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(ticks, len(centre)))
    value = rng.normal(size=len(centre))
    rows = []
    for kick in noise:
        # A first-order process with near unit variance: signals of machines do not jump like white noise.
        value = 0.9 * value + 0.4 * kick
        rows.append(centre + spread * value)
    return np.asarray(rows, dtype=np.float32)


def stream(predictor: Predictor, inputs: Rows) -> Rows:
    """Return PyTorch's results after a reset, ``(tick, number)``: predictions, lower and upper bounds, SI units."""
    like = predictor.front.offset
    x = torch.from_numpy(inputs).to(like).unsqueeze(0)
    with torch.inference_mode():
        prediction, _ = predictor.predict(x, predictor.initial_state(1, x))
        parts = [prediction[0].flatten(1)]
        if predictor.output.coverages:
            bounds, _ = predictor.intervals(x, predictor.initial_state(1, x))
            parts += [bounds[0, :, :, side].flatten(1) for side in (0, 1)]
        return torch.cat(parts, dim=1).float().cpu().numpy()
