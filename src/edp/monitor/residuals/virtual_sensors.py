"""Virtual sensors: networks that tell each group of channels from the others, without its own past.

A network that is fed the past of a faulty channel follows the fault; one that never sees the channel cannot. Each group
has a predictor of horizon 0: its residual is what was measured less what the others say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from edp.data.features import FeatureSet
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.monitor.residuals.base import (
    RESIDUALS,
    FitMaterial,
    ResidualSource,
    ResidualSpec,
    Rows,
    SourceParts,
    mean_inputs,
    middle_of,
    texts_of,
)
from edp.monitor.residuals.groups import Group, groups_of
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead
from edp.networks.losses.mse import MeanSquared
from edp.networks.predictor import ModelSpec, Predictor
from edp.networks.running import stream_predictions
from edp.settings.bounds import MOST_ROWS, MOST_UNITS, above, check_bounds, check_count, integer
from edp.signals import Channel
from edp.training.bagging.spec import BaggingSpec
from edp.training.bundle import Bundle
from edp.training.fit import TrainingSpec, fit

PREFIX = "virtual:"


class VirtualSensors(ResidualSource):
    """Fitted networks, one a group.

    Args:
        bundles: by the name of the group.
        inputs: raw channels, SI units, in the order in which they are fed.
        middle: mean of each on healthy sessions.
    """

    def __init__(self, bundles: dict[str, Bundle], inputs: Sequence[str], middle: Rows) -> None:
        self.bundles, self.inputs = dict(bundles), tuple(inputs)
        self.middle = np.asarray(middle, np.float32)
        names, judged, reads, units = [], [], [], []
        for bundle in self.bundles.values():
            for target, kind in zip(bundle.task.targets, bundle.target_kinds, strict=True):
                names.append(PREFIX + target)
                judged.append((target,))
                reads.append((target, *bundle.task.inputs))
                units.append(Channel(target, kind).unit)
        self.names, self.judged, self.reads, self.units = tuple(names), tuple(judged), tuple(reads), tuple(units)
        index = {name: i for i, name in enumerate(self.inputs)}
        self._columns = [
            ([index[name] for name in bundle.task.inputs], [index[name] for name in bundle.task.targets])
            for bundle in self.bundles.values()
        ]

    def _start(self, streams: int) -> Any:
        return [
            bundle.predictor.initial_state(streams, next(bundle.predictor.parameters()))
            for bundle in self.bundles.values()
        ]

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        parts, states = [], []
        with torch.inference_mode():
            for bundle, (fed, judged), state in zip(self.bundles.values(), self._columns, own, strict=True):
                expected, new = bundle.predictor.predict(torch.from_numpy(np.ascontiguousarray(rows[..., fed])), state)
                parts.append(rows[..., judged] - expected[..., 0, :].numpy())
                states.append(new)
        return np.concatenate(parts, axis=-1), states

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        plain = {"inputs": list(self.inputs), "groups": list(self.bundles)}
        return SourceParts(plain, {"middle": self.middle}, dict(self.bundles))

    @classmethod
    def of_parts(cls, parts: SourceParts) -> VirtualSensors:
        """See `ResidualSource.of_parts`."""
        (inputs, middle), groups = middle_of(parts), texts_of(parts.plain["groups"], "its groups")
        bundles = {}
        for group in groups:
            bundle = parts.bundles[group]
            if not isinstance(bundle, Bundle) or bundle.task.horizons != (0,):
                raise ValueError(f"the network of '{group[:80]}' is no virtual sensor")
            if not {*bundle.task.inputs, *bundle.task.targets} <= {*inputs}:
                raise ValueError(f"the network of '{group[:80]}' reads what is no input of the monitor")
            bundles[group] = bundle
        return cls(bundles, inputs, middle)


@RESIDUALS.register("virtual_sensors")
@dataclass(frozen=True, kw_only=True)
class VirtualSensorsSpec(ResidualSpec):
    """Networks that tell each group of channels from the others: a linear map and a few perceptrons on changes.

    Attributes:
        lags_s: spans of the changes of each channel that are read beside it, s; those shorter than a tick fall away.
        members: perceptrons of a group.
        units: hidden units of each of their two layers.
        rows: ticks that train at most.
        least: share of a channel's mean deviation that a virtual sensor must explain on the sessions that choose; a
            channel that the others say less about is not judged.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = VirtualSensors
    lags_s: tuple[float, ...] = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
    members: int = 2
    units: int = 64
    rows: int = 100_000
    least: float = 0.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "lags_s", tuple(self.lags_s))
        check_bounds(
            "virtual_sensors",
            self,
            lags_s=above(0.0, 60.0),
            members=integer(2, 1000),
            units=integer(1, MOST_UNITS),
            rows=integer(100, MOST_ROWS),
            least=above(-1.0, 1.0),
        )
        check_count("virtual_sensors", "lags_s", self.lags_s, 16, least=1)
        if self.members % FOLDS:
            raise ConfigError(f"virtual_sensors: members = {self.members}; a multiple of {FOLDS} must hold")

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        if material.groups:
            groups: tuple[Group, ...] = tuple(Group(" and ".join(names), names) for names in material.groups)
        else:
            groups = groups_of(material.channels)
        constant = _constant(material)
        material = replace(material, channels=tuple(c for c in material.channels if c.name not in constant))
        groups = tuple(replace(g, judged=tuple(n for n in g.judged if n not in constant)) for g in groups)
        groups = tuple(group for group in groups if group.judged and self._fed(group, material))
        bundles = {}
        for group in groups:
            material.note(f"virtual sensors of {group.name}")
            bundle = self._fitted(group, material, material.minutes / len(groups))
            if bundle is not None:
                bundles[group.name] = bundle
        if not bundles:
            return None
        used = {name for b in bundles.values() for name in (*b.task.inputs, *b.task.targets)}
        inputs = tuple(name for name in material.names if name in used)
        return VirtualSensors(bundles, inputs, mean_inputs(material, inputs))

    def _fed(self, group: Group, material: FitMaterial) -> tuple[Channel, ...]:
        """Channels that the network of a group reads."""
        apart = {*group.judged, *group.unread}
        return tuple(channel for channel in material.channels if channel.name not in apart)

    def _fitted(self, group: Group, material: FitMaterial, minutes: float) -> Bundle | None:
        """The network of a group; None where it explains none of its channels."""
        data = self._prepared(group, group.judged, material)
        fitted = fit(data, self.model(material.rate_hz), self.training(minutes, material))
        explained = _explained(fitted.predictor, data.validation or data.train)
        remaining = tuple(name for name, share in zip(group.judged, explained, strict=True) if share >= self.least)
        if not remaining:
            return None
        if len(remaining) < len(group.judged):
            # The others cost a training once more: a network whose outputs are cut off would be another network.
            data = self._prepared(group, remaining, material)
            fitted = fit(data, self.model(material.rate_hz), self.training(minutes, material))
        facts = {"seconds": fitted.seconds}
        return Bundle(fitted.predictor, data.inputs, data.target_kinds, data.descriptions, facts)

    def model(self, rate_hz: float) -> ModelSpec:
        """The network of each group."""
        lags = sorted({max(1, round(span * rate_hz)) for span in self.lags_s})
        backbone = CommitteeSpec(
            lags=tuple(lags), members=self.members, units=self.units, layers=2, activations=("tanh",)
        )
        return ModelSpec(backbone=backbone, head=LinearHead(), window=max(2, lags[-1]))

    def training(self, minutes: float, material: FitMaterial) -> TrainingSpec:
        """How each is trained: as many steps as the time allows."""
        steps = max(200, min(MOST_STEPS, round(minutes * STEPS_PER_MINUTE)))
        bagging = BaggingSpec(folds=FOLDS, steps=steps, batch=BATCH, rows=self.rows, checks=5)
        return TrainingSpec(loss=MeanSquared(), bagging=bagging, seed=material.seed, device="cpu")

    def _prepared(self, group: Group, judged: tuple[str, ...], material: FitMaterial) -> Prepared:
        fed = self._fed(group, material)
        features = FeatureSet("others", tuple(channel.name for channel in fed))
        task = Task(features, judged, (0,), TargetMode.ABSOLUTE, material.rate_hz)
        kinds = {channel.name: channel.kind for channel in material.channels}
        texts = {channel.name: channel.description for channel in material.channels}
        return Prepared(
            task=task,
            train=[task.series(recording) for recording in material.train],
            validation=_shortened([task.series(recording) for recording in material.validation]),
            test=[],
            inputs=fed,
            feature_kinds=tuple(channel.kind for channel in fed),
            target_kinds=tuple(kinds[name] for name in judged),
            descriptions=tuple(texts[name] for name in judged),
            digest="",
        )


FOLDS = 2
"""Each member leaves out half of the rows, and stops where its error there is least."""
BATCH = 512
STEPS_PER_MINUTE, MOST_STEPS = 10_000, 6_000
"""On one core, about: the time of a fit is a wish and not a bound."""
VALIDATED_TICKS = 120_000
"""For the choice among weights: twenty minutes at 100 Hz say as much as hours."""


def _constant(material: FitMaterial) -> set[str]:
    """Channels that never change: there is nothing to tell about them, nor by them."""
    rows = [session.select(material.names) for session in material.train]
    low, high = (np.stack([f(part, axis=0) for part in rows]) for f in (np.min, np.max))
    still = low.min(axis=0) == high.max(axis=0)
    return {name for name, constant in zip(material.names, still, strict=True) if constant}


def _shortened(series: list[Series]) -> list[Series]:
    """Series of `VALIDATED_TICKS` in all, the same share of each."""
    share = min(1.0, VALIDATED_TICKS / max(1, sum(part.samples for part in series)))
    if share == 1.0:
        return series
    cut = [max(1000, int(part.samples * share)) for part in series]
    return [Series(p.name, p.inputs[:n], p.targets[:n]) for p, n in zip(series, cut, strict=True)]


def _explained(predictor: Predictor, series: Sequence[Series]) -> list[float]:
    """Share of each target's variance that is explained, robust to single bad ticks."""
    predicted = stream_predictions(predictor, series)
    error = np.concatenate([p[:, 0] - part.targets for p, part in zip(predicted, series, strict=True)])
    spread = np.concatenate([part.targets for part in series])
    left = np.abs(error).mean(axis=0) / np.maximum(np.abs(spread - np.median(spread, axis=0)).mean(axis=0), 1e-30)
    return [float(1.0 - value) for value in left]
