"""Look-ahead errors: k-step-ahead predictions of an `edp train` network minus later measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from edp.data.features import FeatureSet
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
from edp.networks.predictor import Predictor
from edp.settings.bounds import above, check_bounds, check_count
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle

SMALLEST_WIDTH = 1e-9
"""Minimum width of an interval, in SI units, because a width of zero cannot scale residuals."""


class LookAhead(ResidualSource):
    """Networks with horizons of one tick and more.

    The residual of a horizon k at tick t is the channel at t less the prediction made at t - k; where the network gives
    intervals, over half the width of the first of them. Such a residual follows a fault of a channel that the network
    reads: it shows onsets and noise, not lasting offsets.

    Args:
        bundles: bundles by a number from 0, as text.
        inputs: raw channels, SI units.
        middle: mean of each on healthy sessions.
    """

    def __init__(self, bundles: dict[str, Bundle], inputs: Sequence[str], middle: Rows) -> None:
        self.bundles, self.inputs, self.middle = dict(bundles), tuple(inputs), np.asarray(middle, np.float32)
        names: list[str] = []
        judged: list[tuple[str, ...]] = []
        reads: list[tuple[str, ...]] = []
        units: list[str] = []
        index = {name: i for i, name in enumerate(self.inputs)}
        self._columns = []
        for number, bundle in self.bundles.items():
            task, scaled = bundle.task, bool(bundle.predictor.output.coverages)
            logged = [i for i, target in enumerate(task.targets) if target in index]
            self._columns.append(
                ([index[name] for name in task.inputs], logged, [index[task.targets[i]] for i in logged])
            )
            for horizon in task.horizons:
                for i in logged:
                    target = task.targets[i]
                    names.append(f"ahead{'' if number == '0' else number}:{target}:{horizon}")
                    judged.append((target,))
                    reads.append(tuple(dict.fromkeys((target, *task.inputs))))
                    units.append("1" if scaled else Channel(target, bundle.target_kinds[i]).unit)
        self.names, self.judged, self.reads, self.units = tuple(names), tuple(judged), tuple(reads), tuple(units)

    def _start(self, streams: int) -> Any:
        states = []
        for bundle, (_, logged, _) in zip(self.bundles.values(), self._columns, strict=True):
            predictor = bundle.predictor
            state = predictor.initial_state(streams, next(predictor.parameters()))
            # The last predictions of each horizon, and half the widths of their intervals; NaN before there are any.
            waiting = [np.full((streams, k, 2, len(logged)), np.nan, np.float32) for k in bundle.task.horizons]
            states.append((state, waiting))
        return states

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        parts, states = [], []
        for bundle, columns, (state, waiting) in zip(self.bundles.values(), self._columns, own, strict=True):
            fed, logged, measured = columns
            with torch.inference_mode():
                x = torch.from_numpy(np.ascontiguousarray(rows[..., fed]))
                predicted, width, state = _predict(bundle.predictor, x, state)
            remaining = []
            for index, horizon in enumerate(bundle.task.horizons):
                now = np.stack([predicted[:, :, index][..., logged], width[:, :, index][..., logged]], axis=2)
                all_of = np.concatenate([waiting[index], now], axis=1)
                due = all_of[:, : rows.shape[1]]
                parts.append((rows[..., measured] - due[:, :, 0]) / due[:, :, 1])
                remaining.append(all_of[:, len(all_of[0]) - horizon :])
            states.append((state, remaining))
        return np.concatenate(parts, axis=-1), states

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        return SourceParts({"inputs": list(self.inputs)}, {"middle": self.middle}, dict(self.bundles))

    @classmethod
    def from_parts(cls, parts: SourceParts) -> LookAhead:
        """See `ResidualSource.from_parts`."""
        inputs, middle = texts_of(parts.plain["inputs"], "its inputs"), source_arrays(parts, {})["middle"]
        bundles = {}
        for number in sorted(parts.bundles, key=lambda text: (len(text), text)):
            bundle = parts.bundles[number]
            if not isinstance(bundle, Bundle) or min(bundle.task.horizons) < 1:
                raise ValueError(f"network {number[:20]} does not look ahead")
            if not {*bundle.task.inputs} <= {*inputs}:
                raise ValueError(f"network {number[:20]} reads what is no input of the monitor")
            bundles[number] = bundle
        return cls(bundles, inputs, middle)


def _predict(predictor: Predictor, x: torch.Tensor, state: Any) -> tuple[Rows, Rows, Any]:
    """Return predictions, half widths of the first intervals (1 without intervals) and the next state."""
    center, bounds, state = predictor.predict_with_intervals(x, state)
    values = center.numpy()
    if bounds is None:
        return values, np.ones_like(values), state
    width = 0.5 * (bounds[:, :, 0, 1] - bounds[:, :, 0, 0]).numpy()
    return values, np.maximum(width, SMALLEST_WIDTH), state


@RESIDUALS.register("look_ahead")
@dataclass(frozen=True, kw_only=True)
class LookAheadSpec(CommitteeOptions, ResidualSpec):
    """Errors of the look-ahead networks that the monitor is given; without any, of one that is trained for it.

    Attributes:
        horizons_s: horizons of the trained network, s; at least one sample.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = LookAhead
    horizons_s: tuple[float, ...] = (0.01, 0.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "horizons_s", tuple(self.horizons_s))
        check_bounds("look_ahead", self, horizons_s=above(0.0, 60.0))
        check_count("look_ahead", "horizons_s", self.horizons_s, 16, least=1)

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        material.progress.note("look-ahead errors")
        names = {*material.names}
        usable = [
            bundle
            for bundle in material.predictors
            if min(bundle.task.horizons) >= 1
            and {*bundle.task.inputs} <= names
            and names.intersection(bundle.task.targets)
            and abs(bundle.task.rate_hz - material.rate_hz) <= 1e-3 * material.rate_hz
        ]
        if not usable:
            own = self._own(material)
            usable = [] if own is None else [own]
        if not usable:
            return None
        used = {name for bundle in usable for name in (*bundle.task.inputs, *bundle.task.targets)}
        inputs = tuple(name for name in material.names if name in used)
        return LookAhead({str(i): b for i, b in enumerate(usable)}, inputs, mean_inputs(material, inputs))

    def _own(self, material: FitMaterial) -> Bundle | None:
        """Train a network from all channels for moving quantities and pressures, or for every channel without these."""
        constant = constant_channels(material)
        channels = [channel for channel in material.channels if channel.name not in constant]
        targets = [channel.name for channel in channels if channel.kind in AHEAD] or [c.name for c in channels]
        if not targets:
            return None
        horizons = tuple(sorted({max(1, round(span * material.rate_hz)) for span in self.horizons_s}))
        features = FeatureSet("all", tuple(channel.name for channel in channels))
        task = Task(features, tuple(targets[:MAX_TARGETS]), horizons, TargetMode.DELTA, material.rate_hz)
        return self.trained(task, material, MINUTES_SHARE * material.minutes)[0]


AHEAD = (Kind.VELOCITY, Kind.ANGULAR_VELOCITY, Kind.PRESSURE, Kind.FLOW, Kind.FORCE)
"""Kinds that the network predicts. Accelerations are mostly noise, and positions follow from velocities."""
MAX_TARGETS = 64
MINUTES_SHARE = 0.2
"""Fraction of the fitting time that the look-ahead network may take."""
