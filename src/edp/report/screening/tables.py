"""The tables of a screening's page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edp.report.screening.views import lag_ranges
from edp.table import Column, Table
from edp.wording import MISSING, count_text, duration, interval, number, percent

if TYPE_CHECKING:
    from edp.data.screening import ChannelVerdict, LagCurve, ScreeningResult
    from edp.evaluation.trials_file import Trials

FLAG_WORDS = {
    "leak of the future": "leak of the future",
    "delayed copy": "delayed copy",
    "duplicate": "duplicate",
    "per-file artefact": "artefact of a file",
    "no relation": "no relation",
    "unsteady relation": "unsteady relation",
    "redundant": "redundant",
    "missing values": "missing values",
    "constant": "constant",
}


def tabulate_kept(screening: ScreeningResult) -> Table:
    """Return the proposed channels by rank."""
    return _choices(screening, "Keep", True)


def tabulate_dropped(screening: ScreeningResult) -> Table:
    """Return the other channels by rank."""
    return _choices(screening, "Drop", False)


def _choices(screening: ScreeningResult, caption: str, keep: bool) -> Table:
    groups = dict(zip(screening.channels, screening.groups))
    rows = tuple(
        (c.channel, groups.get(c.channel, MISSING), number(c.score, 2), _lag(screening, c), c.reason)
        for c in screening.proposal.choices
        if c.keep == keep
    )
    columns = (
        Column("Channel"),
        Column("Kind of signal", is_text=True),
        Column("Score", "0 to 1"),
        Column("Best lag", "samples"),
        Column("Why", is_text=True),
    )
    return Table(caption, columns, rows)


def _lag(screening: ScreeningResult, choice: ChannelVerdict) -> str:
    """Return the best lag against the most dependent target."""
    curves = [c for c in screening.lags if c.channel == choice.channel and c.target != choice.channel]
    if not curves:
        return MISSING
    best = max(curves, key=lambda curve: abs(curve.value))
    text = number(best.best, 0, signed=True)
    return text if best.certain else f"({text})"


def flags_table(screening: ScreeningResult) -> Table:
    """Return the faults of channels, leaks of the future first."""
    order = {kind: rank for rank, kind in enumerate(FLAG_WORDS)}
    ranked = sorted(screening.flags, key=lambda flag: (order.get(str(flag.kind), len(order)), flag.channel))
    rows = tuple(
        (
            flag.channel,
            FLAG_WORDS.get(str(flag.kind), str(flag.kind)),
            flag.source or MISSING,
            count_text(flag.lag) if flag.source else MISSING,
            flag.evidence,
        )
        for flag in ranked
    )
    columns = (
        Column("Channel"),
        Column("What", is_text=True),
        Column("Of", is_text=True),
        Column("Lag", "samples"),
        Column("Evidence", is_text=True),
    )
    return Table("Flags", columns, rows)


def ranges_table(screening: ScreeningResult) -> Table:
    """Return the best lags by kind of signal, in the form of the thesis's Table 4.2."""
    rows = tuple(
        (
            row.group,
            MISSING if row.low is None else f"{count_text(row.low)} to {count_text(row.high)}",
            number(row.median, 1),
            percent(row.leads),
            f"{row.certain} of {row.curves}",
        )
        for row in lag_ranges(screening)
    )
    columns = (
        Column("Kind of signal"), Column("Best lags", "samples"), Column("Median", "samples"), Column("Leads", "share"),
        Column("Certain", "channels"),
    )  # fmt: skip
    return Table(
        "Lags by kind of signal: each unflagged channel against the target that it goes best with", columns, rows
    )


def lags_table(screening: ScreeningResult) -> Table:
    """Return the best lag of each channel against each target, with the correlation there.

    Brackets where it is not certain.
    """
    rows = []
    by_pair = {(curve.channel, curve.target): curve for curve in screening.lags}
    for channel in screening.channels:
        curves = [by_pair.get((channel, target)) for target in screening.targets]
        if any(curve is not None for curve in curves):
            rows.append((channel, *(_cell(channel, curve) for curve in curves)))
    columns = (Column("Channel"), *(Column(target, "lag, correlation") for target in screening.targets))
    return Table("Lag and correlation against each target", columns, tuple(rows))


def _cell(channel: str, curve: LagCurve | None) -> str:
    if curve is None or curve.target == channel:
        return MISSING
    text = f"{number(curve.best, 0, signed=True)}, {number(curve.value, 2)}"
    return text if curve.certain else f"({text})"


def clusters_table(screening: ScreeningResult) -> Table:
    """Return the collinear channels."""
    rows = tuple(
        (cluster.representative, number(cluster.least, 2), ", ".join(cluster.members)) for cluster in screening.clusters
    )
    columns = (
        Column("Speaks for all"),
        Column("Least rank correlation", "of two members"),
        Column("Members", is_text=True),
    )
    return Table("Channels that go together", columns, rows)


def trials_table(trials: Trials) -> Table:
    """Return the held-out error of one network on each feature set."""
    rows = []
    for trial in trials.trials:
        cells = []
        for horizon in trials.persistence:
            gap = (trial.difference or {}).get(horizon)
            cells.append(number(trial.error[horizon], 3))
            cells.append(MISSING if gap is None else interval(gap.low, gap.high, signed=True))
        rows.append((trial.name, count_text(len(trial.channels)), count_text(trial.parameters), *cells))
    still = (cell for error in trials.persistence.values() for cell in (number(error, 3), MISSING))
    rows.append(("persistence", MISSING, MISSING, *still))
    columns: tuple[Column, ...] = (Column("Feature set"), Column("Channels"), Column("Parameters"))
    for horizon in trials.persistence:
        columns += (Column(f"MAE, {horizon} ahead", trials.unit), Column("Against the first", "95 % interval"))
    return Table("Held-out error of one network on each set", columns, tuple(rows), frozenset({0}))


def stages_table(screening: ScreeningResult) -> Table:
    """Return the time of each stage."""
    rows = tuple((stage, duration(seconds)) for stage, seconds in screening.seconds.items())
    return Table("Time of the stages", (Column("Stage"), Column("Time")), rows)
