"""Trials of feature sets: errors of one network for each feature set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edp.settings.results import ResultFile


@dataclass(frozen=True)
class PairedDifference:
    """Difference of an error from the error of the first set, in report units, with its 95 % interval."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class FeatureSetTrial:
    """Evaluated feature set.

    Attributes:
        name: name of the feature set.
        channels: logged channels that it reads.
        features: channels that the network reads, including derived channels.
        parameters: trainable numbers of the network.
        error: mean absolute error by horizon, mean over targets, seeds and ticks of the held-out recordings.
        by_seed: the same for each seed.
        difference: to the first set by horizon, paired over the held-out recordings; None for the first set, and
            where there is one recording only.
        seconds: training time of all seeds, s.
    """

    name: str
    channels: tuple[str, ...]
    features: int
    parameters: int
    error: Mapping[str, float]
    by_seed: Mapping[str, tuple[float, ...]]
    difference: Mapping[str, PairedDifference] | None
    seconds: float


@dataclass(frozen=True)
class Trials(ResultFile):
    """Content of ``trials.json``: all trials in the order of their sets.

    Attributes:
        trials: the first one is what the others are compared with.
        persistence: error of taking the present value, by horizon.
        unit: report unit of the errors.
        held_out: names of the recordings that evaluated.
        notes: sets that could not be tried, and why; channels that had to be added.
    """

    NAME = "trials.json"
    SCHEMA = 1

    trials: tuple[FeatureSetTrial, ...]
    persistence: Mapping[str, float]
    unit: str
    held_out: tuple[str, ...]
    notes: tuple[str, ...]
