"""Virtual sensors: networks that estimate each channel group from the others, without its own past.

A network that is fed the past of a faulty channel follows the fault; one that never sees the channel cannot. Each group
has a predictor of horizon 0: its residual is what was measured less what the others say.

On a controller the networks may take turns, one of them at a tick: each is then a network of a slower rate, and its
residuals keep their values in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from edp.data.features import FeatureSet
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.monitor.residuals.base import (
    RESIDUALS,
    FitMaterial,
    ResidualSource,
    ResidualSpec,
    Rows,
    SourceParts,
    mean_inputs,
    source_arrays,
    texts_of,
)
from edp.monitor.residuals.committees import CommitteeOptions, constant_channels
from edp.monitor.residuals.groups import Group, groups_of
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.settings.bounds import above, check_bounds, integer, shown
from edp.signals import Channel
from edp.training.bundle import Bundle

PREFIX = "virtual:"
MAX_EVERY = 1000
"""Ticks from one run of a network to the next."""


@dataclass(frozen=True, eq=False)
class _Turn:
    """Schedule of one network: samples until its next run, its last residuals (streams, evaluated), its state."""

    due: int
    residuals: Rows
    network: Any


class VirtualSensors(ResidualSource):
    """Fitted networks, one a group.

    Args:
        bundles: bundles by group name.
        inputs: raw channels, SI units, in the order in which they are fed.
        middle: mean of each on healthy sessions.
        every: ticks from one run of a network to the next; network n runs first at tick n modulo `every`.
    """

    def __init__(self, bundles: dict[str, Bundle], inputs: Sequence[str], middle: Rows, every: int = 1) -> None:
        self.bundles, self.inputs, self.every = dict(bundles), tuple(inputs), every
        self.delay = every - 1
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
            _Turn(
                number % self.every,
                np.full((streams, len(judged)), np.nan, np.float32),
                bundle.predictor.initial_state(streams, next(bundle.predictor.parameters())),
            )
            for number, (bundle, (_, judged)) in enumerate(zip(self.bundles.values(), self._columns, strict=True))
        ]

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        parts, turns = [], []
        with torch.inference_mode():
            for bundle, (fed, judged), turn in zip(self.bundles.values(), self._columns, own, strict=True):
                at = slice(turn.due, None, self.every)
                residuals, network = turn.residuals[:, None], turn.network
                if turn.due < rows.shape[1]:
                    fed_rows = torch.from_numpy(np.ascontiguousarray(rows[:, at, fed]))
                    expected, network = bundle.predictor.predict(fed_rows, turn.network)
                    differences = rows[:, at, judged] - expected[..., 0, :].numpy()
                    # What stood in for a missing value must not outlast the tick.
                    differences[~(there[:, at, fed].all(axis=-1, keepdims=True) & there[:, at, judged])] = np.nan
                    residuals = np.concatenate([residuals, differences], axis=1)
                newest = (np.arange(rows.shape[1]) - turn.due) // self.every + 1
                parts.append(residuals[:, newest])
                turns.append(_Turn((turn.due - rows.shape[1]) % self.every, residuals[:, -1], network))
        return np.concatenate(parts, axis=-1), turns

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        plain = {"inputs": list(self.inputs), "groups": list(self.bundles), "every": self.every}
        return SourceParts(plain, {"middle": self.middle}, dict(self.bundles))

    @classmethod
    def from_parts(cls, parts: SourceParts) -> VirtualSensors:
        """See `ResidualSource.from_parts`."""
        inputs, middle = texts_of(parts.plain["inputs"], "its inputs"), source_arrays(parts, {})["middle"]
        groups = texts_of(parts.plain["groups"], "its groups")
        every = parts.plain.get("every", 1)  # monitors of earlier versions have none
        if type(every) is not int or not 1 <= every <= MAX_EVERY:
            raise ValueError(f"its networks run every {shown(every)} ticks; an integer of 1 to {MAX_EVERY} must hold")
        bundles = {}
        for group in groups:
            bundle = parts.bundles[group]
            if not isinstance(bundle, Bundle) or bundle.task.horizons != (0,):
                raise ValueError(f"the network of '{group[:80]}' is no virtual sensor")
            if not {*bundle.task.inputs, *bundle.task.targets} <= {*inputs}:
                raise ValueError(f"the network of '{group[:80]}' reads what is no input of the monitor")
            bundles[group] = bundle
        return cls(bundles, inputs, middle, every)


@RESIDUALS.register("virtual_sensors")
@dataclass(frozen=True, kw_only=True)
class VirtualSensorsSpec(CommitteeOptions, ResidualSpec):
    """Networks that estimate each channel group from the others: a linear map and some perceptrons on changes.

    Attributes:
        min_explained: share of a channel's mean deviation that a virtual sensor must explain on the sessions that
            choose; a channel that the others say less about is not evaluated.
        every: ticks from one run of a network to the next, 1 by default. Networks take turns, are trained at that
            slower rate (spans in `lags_s` shorter than it are one run), and residuals hold in between: a controller
            has one of n networks to run at a tick where it is n or more.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = VirtualSensors
    min_explained: float = 0.1
    every: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds("virtual_sensors", self, min_explained=above(-1.0, 1.0), every=integer(1, MAX_EVERY))

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        bundles = {}
        groups = self.groups(material)
        for group in groups:
            material.progress.note(f"virtual sensors of {group.name}")
            bundle = self.network(group, material, len(groups))
            if bundle is not None:
                bundles[group.name] = bundle
        return self.together(bundles, material)

    def groups(self, material: FitMaterial) -> tuple[Group, ...]:
        """Return the channel groups with one network each."""
        if material.groups:
            groups: tuple[Group, ...] = tuple(Group(" and ".join(names), names) for names in material.groups)
        else:
            groups = groups_of(material.channels)
        constant = constant_channels(material)
        changing = replace(material, channels=tuple(c for c in material.channels if c.name not in constant))
        groups = tuple(replace(g, judged=tuple(n for n in g.judged if n not in constant)) for g in groups)
        return tuple(group for group in groups if group.judged and self._select_inputs(group, changing))

    def network(self, group: Group, material: FitMaterial, networks: int) -> Bundle | None:
        """Train the network of a group with its part of the time budget; None if it explains no channel."""
        constant = constant_channels(material)
        changing = replace(material, channels=tuple(c for c in material.channels if c.name not in constant))
        if self.every > 1:
            changing = slower(changing, self.every)
        return self._fit_group(group, changing, 0.8 * material.minutes / networks)

    def together(self, bundles: dict[str, Bundle], material: FitMaterial) -> VirtualSensors | None:
        """Create the source of these networks; None without any."""
        if not bundles:
            return None
        used = {name for b in bundles.values() for name in (*b.task.inputs, *b.task.targets)}
        inputs = tuple(name for name in material.names if name in used)
        return VirtualSensors(bundles, inputs, mean_inputs(material, inputs), self.every)

    def _select_inputs(self, group: Group, material: FitMaterial) -> tuple[Channel, ...]:
        """Return the channels that the network of a group reads."""
        apart = {*group.judged, *group.unread}
        return tuple(channel for channel in material.channels if channel.name not in apart)

    def _fit_group(self, group: Group, material: FitMaterial, minutes: float) -> Bundle | None:
        """Train the network of a group; None if it explains no channel."""
        bundle, data = self.trained(self._task(group, group.judged, material), material, minutes)
        explained = _compute_explained(bundle.predictor, data.validation or data.train)
        remaining = tuple(
            name for name, share in zip(group.judged, explained, strict=True) if share >= self.min_explained
        )
        if not remaining:
            return None
        if len(remaining) < len(group.judged):
            # The others cost a training once more: a network whose outputs are cut off would be another network.
            bundle, _ = self.trained(self._task(group, remaining, material), material, minutes)
        return bundle

    def _task(self, group: Group, judged: tuple[str, ...], material: FitMaterial) -> Task:
        features = FeatureSet("others", tuple(channel.name for channel in self._select_inputs(group, material)))
        return Task(features, judged, (0,), TargetMode.ABSOLUTE, material.rate_hz)


def slower(material: FitMaterial, every: int) -> FitMaterial:
    """Return the material in which only every n-th tick was recorded."""
    rate = material.rate_hz / every
    train, validation = (
        tuple(replace(part, values=part.values[::every], rate_hz=rate) for part in parts)
        for parts in (material.train, material.validation)
    )
    return replace(material, train=train, validation=validation, rate_hz=rate)


def _compute_explained(predictor: Predictor, series: Sequence[Series]) -> list[float]:
    """Share of each target's variance that is explained, robust to single bad ticks."""
    predicted = stream_predictions(predictor, series)
    error = np.concatenate([p[:, 0] - part.targets for p, part in zip(predicted, series, strict=True)])
    spread = np.concatenate([part.targets for part in series])
    left = np.abs(error).mean(axis=0) / np.maximum(np.abs(spread - np.median(spread, axis=0)).mean(axis=0), 1e-30)
    return [float(1.0 - value) for value in left]
