"""Plan of the smaller networks of a search; refusal of a budget that no network of this kind meets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import ConfigError, ExportError
from edp.evaluation.controller import Budget, ResourceUsage
from edp.networks.narrow import student, width_of
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.training.bundle import blank_scaler
from edp.training.compression.pruning import check_pruning
from edp.workflows.compression.bench import CompressionRequest
from edp.workflows.compression.formats import FORMATS, resource_usage
from edp.workflows.compression.variants import make_rounded_request

STEP = 4  # widths are multiples of it: what kernels compute at a time
RECIPES = ("distilled", "pruned")  # and the better one is trained on with rounded numbers
SHARES = (1.0, 0.5, 0.25)  # of the widest that fits: the front below it


@dataclass(frozen=True)
class CompressionPlan:
    """Requests of a compression.

    Attributes:
        orders: the recipes for each width, widest first.
        formats: number formats to evaluate.
        notes: omitted alternatives, each with the reason.
    """

    orders: Mapping[int, tuple[CompressionRequest, ...]]
    formats: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def rounds(self) -> bool:
        """Test whether quantisation-aware training is useful."""
        return any(FORMATS[name].rounded for name in self.formats)

    @property
    def trainings(self) -> int:
        """How many there are."""
        return sum(len(orders) + self.rounds for orders in self.orders.values())

    def to_round(self, errors: Mapping[CompressionRequest, float]) -> list[CompressionRequest]:
        """Return the requests that train the better recipe of each width with rounded weights.

        Args:
            errors: error in float32, by recipe; a recipe without an entry failed.
        """
        if not self.rounds:
            return []
        # The better recipe is chosen in float: rounding both would double the trainings.
        return [
            make_rounded_request(min(orders, key=lambda order: errors.get(order, math.inf)))
            for orders in self.orders.values()
        ]


def make_plan(
    teacher: Predictor,
    budget: Budget,
    units: Sequence[int] = (),
    formats: Sequence[str] = (),
    recipes: Sequence[str] = RECIPES,
    shares: Sequence[float] = SHARES,
) -> CompressionPlan:
    """Plan a search: the widest network that fits in each format, and its halves and quarters.

    Args:
        teacher: the network; its weights need not be trained.
        budget: limits of the controller.
        units: widths to make; none given, they are planned.
        formats: names of number formats; none given, all.
        recipes: some of `RECIPES`.
        shares: fractions of the widest network that fits; each gives one width.

    Raises:
        ConfigError: an unknown format or recipe, a width that is none, or a budget that no network of this kind meets.
    """
    full = width_of(teacher.spec)
    unknown = [recipe for recipe in recipes if recipe not in RECIPES]
    if unknown or not recipes:
        raise ConfigError(f"recipes = {', '.join(unknown) or 'none'}; some of {', '.join(RECIPES)} must hold")
    wrong = [width for width in units if not 1 <= width <= full]
    if wrong:
        raise ConfigError(
            f"units = {', '.join(map(str, wrong))}; 1 <= units <= {full}, those of the teacher, must hold"
        )
    # One and two units are there for budgets that no multiple of four meets.
    possible = [width for width in sorted({1, 2, full, *range(STEP, full, STEP)}) if width <= full]
    possible = [width for width in possible if not _why_not(teacher, _narrow(teacher.spec, width))]
    supported, notes = _select_formats(teacher, possible[0], formats or list(FORMATS))
    fitting = {name: _widest(teacher, name, budget, possible) for name in supported}
    if not any(fitting.values()):
        raise ConfigError(_refusal(teacher, budget, supported, possible[0]))
    for name, width in fitting.items():
        if not width:
            notes.append(f"no width fits the budget in {FORMATS[name].label}")
    tops = set(fitting.values()) - {0}
    goals = {max(tops) * share for share in shares}
    # Halves and quarters are rounded down to a possible width, so that they fit as well.
    widths = set(units) or tops | {max([width for width in possible if width <= goal] or tops) for goal in goals}
    orders = {width: _orders(teacher, width, recipes, notes) for width in sorted(widths - {full}, reverse=True)}
    return CompressionPlan(orders, tuple(supported), tuple(dict.fromkeys(notes)))


def _orders(teacher: Predictor, width: int, recipes: Sequence[str], notes: list[str]) -> tuple[CompressionRequest, ...]:
    """Return the recipes for a network of this width; notes state why others are impossible."""
    both = {
        "distilled": CompressionRequest(name=f"u{width}", units=width),
        "pruned": CompressionRequest(name=f"p{width}", units=width, pruned=True),
    }
    orders = [order for recipe, order in both.items() if recipe in recipes]
    # What cannot be pruned can still be distilled.
    try:
        check_pruning(teacher.spec, _narrow(teacher.spec, width))
    except ConfigError as error:
        notes.append(str(error))
        orders = [both["distilled"]]
    why = {order: _why_not(teacher, order.model(teacher.spec)) for order in orders}
    notes += [f"{recipe.name} is left out: {reason}" for recipe, reason in why.items() if reason]
    supported = tuple(recipe for recipe, reason in why.items() if not reason)
    if not supported:
        raise ConfigError("; ".join(reason for reason in why.values() if reason))
    return supported


def _why_not(teacher: Predictor, model: ModelSpec) -> str:
    """Return why a network of these settings cannot be built; empty where it can."""
    try:
        _build_untrained(model, teacher.task)
    except ConfigError as error:
        return str(error)
    return ""


def _select_formats(teacher: Predictor, least: int, formats: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the formats that support every part of the network, and the reasons against the others."""
    net = _build_untrained(_narrow(teacher.spec, least), teacher.task)
    # Two windows of random inputs suffice to find whether a format has a form for every part.
    drawn = np.random.default_rng(0).normal(size=(2 * net.spec.window, len(net.task.inputs))).astype(np.float32)
    series = [Series("drawn", drawn, np.zeros((len(drawn), len(net.task.targets)), dtype=np.float32))]
    supported, notes = [], []
    for name in formats:
        try:
            FORMATS[name]().predictions(net, series)
        except ExportError as error:
            notes.append(f"number format '{name}' is left out: {error}")
        else:
            supported.append(name)
    if not supported:
        raise ConfigError("; ".join(notes))
    return supported, notes


def _narrow(model: ModelSpec, units: int) -> ModelSpec:
    """Return a student with all levels of the teacher."""
    channels = getattr(model.backbone, "channels", None)
    return student(model, units, None if channels is None else len(channels))


def _build_untrained(model: ModelSpec, task: Task) -> Predictor:
    # Counts depend on sizes only: weights are not trained for them.
    return build_model(task, model, blank_scaler(task), seed=0)


def _usage_at(teacher: Predictor, units: int, name: str, budget: Budget) -> ResourceUsage:
    return resource_usage(_build_untrained(_narrow(teacher.spec, units), teacher.task), name, budget)


def _widest(teacher: Predictor, name: str, budget: Budget, widths: Sequence[int]) -> int:
    """Return the width of the widest network within the budget; 0 without one."""
    low, high = 0, len(widths)  # those before `low` fit, those from `high` on do not
    # Cost rises with the width, so bisection finds the widest that fits in a few builds.
    while low < high:
        middle = (low + high) // 2
        if _usage_at(teacher, widths[middle], name, budget).over(budget):
            high = middle
        else:
            low = middle + 1
    return widths[low - 1] if low else 0


def _refusal(teacher: Predictor, budget: Budget, formats: Sequence[str], least_width: int) -> str:
    """State the needs of the nearest network and the necessary limits."""
    least = {name: _usage_at(teacher, least_width, name, budget) for name in formats}

    def worst(name: str) -> float:
        return max(value / limit for value, limit in least[name].over(budget).values())

    # The nearest is the one whose worst limit is exceeded by the least factor.
    nearest = min(formats, key=worst)
    over = least[nearest].over(budget)
    granted = ", ".join(f"{limit} = {pair[1]:,}" for limit, pair in over.items())
    needed = ", ".join(f"{limit} = {pair[0]:,}" for limit, pair in over.items())
    return (
        f"budget '{budget.name}': {granted} can be met by no width of this network in any number format. The nearest "
        f"that would work is one of {'a single unit' if least_width == 1 else f'{least_width} units'} in "
        f"{FORMATS[nearest].label}, with {needed}: raise these limits to that at least, leave out blocks, or read "
        "fewer channels"
    )
