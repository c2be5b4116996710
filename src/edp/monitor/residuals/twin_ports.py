"""Twin with free ports of the monitored group: plant model against machine, other states measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

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
from edp.monitor.residuals.groups import groups_of
from edp.settings.bounds import above, check_bounds
from edp.training.twin_bundle import TwinBundle

MAX_PERIOD = 10_000_000
"""Maximum number of samples between two measured samples."""


class TwinPorts(ResidualSource):
    """Twin run once per group of its outputs, with free ports for the group and measured ones for the others.

    Every `period` ticks the ports of the group read what is measured, so that free runs do not drift away; the residual
    of that tick still is against the free run up to it.

    Args:
        bundle: the twin.
        groups: names of answers that are evaluated together.
        period: ticks from one measured tick of a group to the next.
        inputs: raw channels, SI units.
        middle: mean of each on healthy sessions.
    """

    def __init__(
        self, bundle: TwinBundle, groups: Sequence[Sequence[str]], period: int, inputs: Sequence[str], middle: Rows
    ) -> None:
        self.bundle, self.groups, self.period = bundle, tuple(tuple(group) for group in groups), period
        self.inputs, self.middle = tuple(inputs), np.asarray(middle, np.float32)
        channels = bundle.twin.channels
        answers = [channel.name for channel in channels.answers]
        units = {channel.name: channel.unit for channel in channels.answers}
        index = {name: i for i, name in enumerate(self.inputs)}
        self._commands = [index[channel.name] for channel in channels.commands]
        self._answers = [index[name] for name in answers]
        self._free = [[answers.index(name) for name in group] for group in self.groups]
        judged = [name for group in self.groups for name in group]
        self.names = tuple(f"twin:{name}" for name in judged)
        self.judged = tuple((name,) for name in judged)
        self.reads = tuple(self.inputs for _ in judged)
        self.units = tuple(units[name] for name in judged)

    def _start(self, streams: int) -> Any:
        # None until the first tick, which is what is expected at that tick.
        return None

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        twin = self.bundle.twin
        commands, measured = rows[..., self._commands], rows[..., self._answers]
        if own is None:
            # At rest at the means of its training data, as exported plants begin; the measured prefix does the rest.
            scales, lanes = twin.scales, len(rows)
            means = [np.repeat(mean[None], lanes, axis=0) for mean in (scales.command_offset, scales.answer_offset)]
            start = [twin.initial_state(means[0], means[1]) for _ in self.groups]
            own = (0, start, [measured[:, 0] for _ in self.groups])
        ticks, states, expected = own
        at = np.arange(ticks, ticks + rows.shape[1])
        # All is measured at first, as long as the twin needs to know the machine.
        free = (at >= twin.prefix_ticks) & ((at - twin.prefix_ticks) % self.period != 0)
        parts, new_states, new_expected = [], [], []
        for columns, state, before in zip(self._free, states, expected, strict=True):
            chosen = np.isin(np.arange(len(self._answers)), columns)
            fed = np.where(free[:, None] & chosen, np.float32(np.nan), measured)
            answers, state = twin.rollout(commands, state, fed)
            # Row t of the answers is the machine one tick after row t.
            due = np.concatenate([before[:, None], answers[:, :-1]], axis=1)
            parts.append((measured - due)[..., columns])
            new_states.append(state)
            new_expected.append(answers[:, -1])
        # The count stays small for ever, and within a period tells the same.
        ticks += rows.shape[1]
        beyond = twin.prefix_ticks + self.period
        ticks = ticks if ticks < beyond else twin.prefix_ticks + (ticks - twin.prefix_ticks) % self.period
        return np.concatenate(parts, axis=-1), (ticks, new_states, new_expected)

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        plain = {
            "inputs": list(self.inputs),
            "groups": [list(group) for group in self.groups],
            "period": self.period,
        }
        return SourceParts(plain, {"middle": self.middle}, {"twin": self.bundle})

    @classmethod
    def from_parts(cls, parts: SourceParts) -> TwinPorts:
        """See `ResidualSource.from_parts`."""
        inputs, middle = texts_of(parts.plain["inputs"], "its inputs"), source_arrays(parts, {})["middle"]
        bundle, period, groups = parts.bundles["twin"], parts.plain["period"], parts.plain["groups"]
        if not isinstance(bundle, TwinBundle):
            raise ValueError("its network is no twin")
        if isinstance(period, bool) or not isinstance(period, int) or not 1 <= period <= MAX_PERIOD:
            raise ValueError(f"its period is {str(period)[:40]}; 1 to {MAX_PERIOD:,} ticks must hold")
        if not isinstance(groups, list):
            raise ValueError("its groups are no list")
        named = [texts_of(group, "a group") for group in groups]
        channels = bundle.twin.channels
        answers = [channel.name for channel in channels.answers]
        if not {*answers, *(channel.name for channel in channels.commands)} <= {*inputs}:
            raise ValueError("its twin reads what is no input of the monitor")
        if not {name for group in named for name in group} <= {*answers}:
            raise ValueError("a group names what its twin does not answer")
        return cls(bundle, named, period, inputs, middle)


@RESIDUALS.register("twin_ports")
@dataclass(frozen=True, kw_only=True)
class TwinPortsSpec(ResidualSpec):
    """Residuals of the first twin of the monitor with free ports; empty without a twin.

    Attributes:
        free_s: time that the ports of a group run free before they are measured again, s.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = TwinPorts
    free_s: float = 1.0

    def __post_init__(self) -> None:
        check_bounds("twin_ports", self, free_s=above(0.0, 3600.0))

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        for bundle in material.twins:
            channels = bundle.twin.channels
            needed = [channel.name for channel in (*channels.commands, *channels.answers)]
            same_rate = abs(channels.rate_hz - material.rate_hz) <= 1e-3 * material.rate_hz
            if not {*needed} <= {*material.names} or not same_rate:
                continue
            material.progress.note("free ports of the twin")
            answers = {channel.name for channel in channels.answers}
            strokes = {channel.name for channel in channels.strokes}
            groups = [
                # A stroke is the integral of its velocity: both are free together.
                tuple(name for name in (*group.judged, *group.unread) if name in answers)
                for group in groups_of(tuple(c for c in material.channels if c.name in answers))
            ]
            groups = [group for group in groups if group] or [tuple(sorted(answers))]
            if strokes and not any(strokes & {*group} for group in groups):
                groups.append(tuple(sorted(strokes)))
            inputs = tuple(name for name in material.names if name in needed)
            period = max(1, round(self.free_s * material.rate_hz))
            return TwinPorts(bundle, groups, period, inputs, mean_inputs(material, inputs))
        return None
