"""By what unknown logs are divided into training and test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from edp.data.even_split import blocks_where_time_is_uneven, rests_where_it_tests
from edp.data.splits import ByName, ByTime
from edp.errors import count_of
from edp.logs.proposal.columns import LogLook
from edp.logs.proposal.groups import LogGroup
from edp.logs.proposal.propose import MapProposal
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.proposal_files import horizons_for

_LEAST_RECORDINGS = 5
"""Recordings from which whole ones test; of fewer a single one would decide the score."""
_MOVES = 0.1
"""Of its largest deviation in a log, what a column has at least in one in which it moves."""
_IN_MOST, _LEAST_TESTED = 0.7, 1.5
"""Share of the logs in which a machine moves all that it moves; test logs in which a column should move on average."""


def choose_split(group: LogGroup, proposal: MapProposal, targets: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Whole logs where there are many, else time; blocks where ends are unlike the rest; and why, for notes."""
    idle = _rests_in_most(group, proposal, targets) if len(group.paths) >= _LEAST_RECORDINGS else ""
    if len(group.paths) >= _LEAST_RECORDINGS and not idle:
        return {"kind": "names"}, []
    because = [idle] if idle else []
    rate = proposal.clock.wanted_hz or proposal.clock.rate_hz
    names = list(dict.fromkeys(guess.column for guess in proposal.columns if guess.channel in targets))
    if rate and names and (idle or len(group.looks) == len(group.paths)):
        step = max(1, round((proposal.clock.rate_hz or rate) / rate))
        logs = [_targets_of(look, names, step, rate) for look in group.looks]
        uneven = blocks_where_time_is_uneven(logs, names, horizons_for(rate), ByTime())
        if uneven is not None:
            blocks, why = uneven  # of a long log a part was looked at
            longer = min(look.rows / step for look in group.looks) / min(log.samples for log in logs)
            split = {"kind": "blocks", "block_s": round(blocks.block_s * max(1.0, longer), 2), "every": blocks.every}
            return split, [*because, f"{why}: blocks of time test in turn"]
        if rests_where_it_tests(logs, names, horizons_for(rate), ByTime()):
            return {"kind": "time"}, [
                *because,
                "the machine moves in so small a part of this that the end, which would test, is mostly rest, and so "
                "are blocks of it: a test there says little; record more motion, or give a part that moves",
            ]
    return {"kind": "time"}, because


def _rests_in_most(group: LogGroup, proposal: MapProposal, targets: Sequence[str]) -> str:
    """Why whole logs would not test an output or a command, since it moves in few of them; empty where they would."""
    tests = max(1, round(ByName.test_share * len(group.paths)))
    for guess in proposal.columns:
        if guess.channel not in targets and not (guess.channel and guess.role == "command"):
            continue
        sizes = np.array([_size(look, guess.column) for look in group.looks])
        moving = sizes > _MOVES * sizes.max()
        if moving.mean() < _IN_MOST and tests * moving.mean() < _LEAST_TESTED:
            return (
                f"{guess.column[:40]} moves in {np.count_nonzero(moving)} of {count_of(len(sizes), 'log')}: the end "
                "of each log "
                "tests, since a whole one shows little of the others (split)"
            )
    return ""


def _size(look: LogLook, name: str) -> float:
    """How much a column of a log moves: its standard deviation."""
    values = next(column.values for column in look.columns if column.name == name)
    values = values[np.isfinite(values)]
    return float(np.std(values)) if len(values) else 0.0


def _targets_of(look: LogLook, names: Sequence[str], step: int, rate: float) -> Recording:
    """Columns of what was looked at of a log; where pieces of it meet, a missing value keeps their changes apart."""
    columns = {column.name: column for column in look.columns}
    apart = np.full(1, np.nan)
    values = [np.concatenate([x for piece in columns[name].pieces for x in (piece[::step], apart)]) for name in names]
    channels = tuple(Channel(name, Kind.GENERIC) for name in names)
    return Recording(look.path.name, channels, np.stack(values, axis=1).astype(np.float32), rate)
