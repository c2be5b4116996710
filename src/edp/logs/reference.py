"""The reference page of channels, kinds and units: ``python -m edp.logs.reference > docs/reference/channels.md``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence

from edp.logs.units import ALIASES
from edp.signals import (
    EXTRA_CHANNELS,
    FAULT_CHANNELS,
    GROUND_CHANNELS,
    KINDS,
    MOTOR_CHANNELS,
    TABLE_A1,
    TIME_UNITS,
    UNITS,
    Channel,
    Kind,
)
from edp.wording import typed

_MEANING: Mapping[Kind, str] = {
    Kind.VELOCITY: "of a cylinder or another axis that moves straight",
    Kind.ACCELERATION: "of the same",
    Kind.POSITION: "stroke, displacement, height",
    Kind.PRESSURE: "of a chamber, pump or tank",
    Kind.PILOT_PRESSURE: "of a lever's hydraulic signal: a command",
    Kind.ANGLE: "of a joint or shaft",
    Kind.ANGULAR_VELOCITY: "of the same",
    Kind.FORCE: "of a cylinder, at a tool",
    Kind.FLOW: "of oil",
    Kind.MASS: "payload",
    Kind.TEMPERATURE: "of oil",
    Kind.VOLTAGE: "of a valve: a command",
    Kind.CURRENT: "of a valve: a command",
    Kind.RATIO: "lever, spool, opening, duty, share: a command",
    Kind.GENERIC: "anything else: numbers as they are, never converted",
}


def reference_page() -> str:
    """Return the reference page of channels, kinds and units as Markdown."""
    return "\n".join(
        [
            "# Channels, kinds and units",
            "",
            "What a [signal map](../howto/map_columns.md) may name. This page is written by",
            "`python -m edp.logs.reference` from `edp.signals`; a test holds it to the code.",
            "",
            "## Kinds",
            "",
            "A channel's `kind` says what it measures. Values are stored in the SI unit and shown in the unit of",
            "reports. Beyond the plausible limits `edp data check` warns.",
            "",
            *_table(("kind", "SI unit", "in reports", "plausible, SI", "is"), _kinds()),
            "",
            "## Units",
            "",
            "A `unit` is that of the numbers in the file: SI value = number x factor + offset.",
            "",
            *_table(("unit", "kind", "factor", "offset", "also spelt"), _units()),
            "",
            f"Time columns are in {_words(TIME_UNITS)} (`time_unit`).",
            "",
            "## Names with a meaning",
            "",
            "Columns with these names need no map; a map that names one of them needs no `kind`. Any other name is",
            "free.",
            "",
            "### Table A.1: what an excavator logs",
            "",
            *_table(("channel", "kind", "is"), _channels(TABLE_A1.values())),
            "",
            "### Further channels of the simulator",
            "",
            *_table(("channel", "kind", "is"), _channels(EXTRA_CHANNELS.values())),
            "",
            "Where a recording [swings and travels](../howto/simulate_recordings.md), these come behind them:",
            "",
            *_table(("channel", "kind", "is"), _channels(MOTOR_CHANNELS.values())),
            "",
            f"In soil {_span(GROUND_CHANNELS)} come with them, with faults {_span(FAULT_CHANNELS)}.",
            "",
        ]
    )


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [_row(headings), "|" + "---|" * len(headings), *map(_row, rows)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _words(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _kinds() -> Iterable[list[str]]:
    for kind, facts in KINDS.items():
        low, high = facts.plausible
        limits = "any" if kind is Kind.GENERIC else f"{typed(low, 6)} to {typed(high, 6)}"
        yield [f"`{kind}`", f"`{facts.si_unit}`", f"`{facts.report_unit}`", limits, _MEANING[kind]]


def _units() -> Iterable[list[str]]:
    for name, unit in UNITS.items():
        spelt = [alias for alias, usual in ALIASES.items() if usual == name]
        offset = typed(unit.offset, 6) if unit.offset else ""
        yield [f"`{name}`", _words(unit.kinds), f"{unit.factor:.10g}", offset, _words(spelt)]


def _channels(channels: Iterable[Channel]) -> Iterable[list[str]]:
    for channel in channels:
        yield [f"`{channel.name}`", f"`{channel.kind}`", channel.description]


def _span(channels: Mapping[str, Channel]) -> str:
    names, kind = list(channels), next(iter(channels.values())).kind
    return f"`{names[0]}` to `{names[-1]}` (`{kind}`)"


if __name__ == "__main__":
    sys.stdout.write(reference_page())
