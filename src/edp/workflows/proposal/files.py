"""The files that a proposal for unknown logs consists of: signal map, settings and data set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import tomli_w

from edp.errors import DataError
from edp.logs.proposal.propose import MapProposal
from edp.logs.read import unique_names
from edp.logs.source import map_of_table
from edp.settings.tree import parse_toml
from edp.signals import VOCABULARY, Kind, SignalMap
from edp.storage.paths import full_path

MAP, SETTINGS, DATA = "map.toml", "settings.toml", "data.toml"
MAX_FEATURES = 48
_AHEAD_S = 0.1
"""Prediction horizon that is useful to a controller: two steps of a slow hydraulic valve."""
_SLOW_TICKS = 5
"""Ticks ahead where a tick takes longer than half of that."""


def horizons_for(rate_hz: float | None) -> tuple[int, int]:
    """Return the look-ahead in samples: one, and a tenth of a second or five."""
    ahead = round(_AHEAD_S * (rate_hz or 0.0))
    return 1, ahead if ahead > 1 else _SLOW_TICKS


def map_table(signal_map: SignalMap) -> dict[str, object]:
    """Return a signal map as in a file, without default values."""
    table: dict[str, object] = {}
    for key in ("time", "sample_time_s", "rate_hz"):
        value = getattr(signal_map, key)
        if value is not None:
            table[key] = value
    if signal_map.time is not None and signal_map.time_unit != "s":
        table["time_unit"] = signal_map.time_unit
    if not signal_map.header:
        table |= {"header": False, "columns": list(signal_map.columns)}
    table["channels"] = {
        entry.name: {"column": entry.column}
        | ({} if _usual_kind(entry.name) == entry.kind else {"kind": str(entry.kind)})
        | {"unit": entry.unit or "1"}
        for entry in signal_map.channels
    }
    return table


def _usual_kind(name: str) -> Kind | None:
    channel = VOCABULARY.get(name)
    return None if channel is None else channel.kind


def remarks_of(paths: Sequence[Path], proposal: MapProposal) -> list[str]:
    """Return the comments at the top of a map: its source and points to check."""
    lines = [f"Proposed by edp init for {', '.join(path.name for path in paths)}. To be checked:"]
    checked = [guess for guess in proposal.columns if guess.check and guess.channel]
    lines += [f"  {guess.channel}: {guess.role}, {guess.sureness}; {guess.check}" for guess in checked]
    if proposal.clock.check:
        lines.append(f"  time: {proposal.clock.check}")
    absent = [guess for guess in proposal.columns if not guess.channel and guess.role != "time"]
    lines += [f"Not taken: {guess.column[:60]} ({guess.role}: {guess.why})" for guess in absent[:MAX_FEATURES]]
    return lines


def toml_text(table: Mapping[str, object], remarks: Iterable[str] = ()) -> str:
    """Return TOML with comments above; a comment ends at no character of a name."""
    visible = ["".join(letter if letter.isprintable() else "?" for letter in line) for line in remarks]
    return "".join(f"# {line}\n" for line in visible) + tomli_w.dumps(table)


def settings_text(
    proposal: MapProposal, channels: Sequence[str], targets: Sequence[str], split: dict[str, object]
) -> str:
    """Return settings as in a file: task, features and split."""
    clock = proposal.clock
    rate = clock.wanted_hz or clock.rate_hz
    table = {
        "task": {
            "targets": list(targets),
            "horizons": list(horizons_for(rate)),
            "mode": "delta",
            "features": {"name": "proposed", "channels": list(channels)},
        },
        "split": split,
    }
    return toml_text(
        table, ["Proposed by edp init: what is predicted, how far ahead (in samples), from what, tested on what."]
    )


def name_paths(paths: Sequence[Path]) -> list[tuple[Path, str]]:
    """Return the paths that a data-set file can list, each with a unique name."""
    # A data-set file expands environment variables in paths.
    usable = [path for path in paths if "$" not in str(full_path(path)) and str(path).isprintable()]
    return list(zip(usable, unique_names([path.stem for path in usable], usable)))


def data_set_text(
    recordings: Sequence[Mapping[str, object]], map_file: str | None = None, repair: dict[str, str] | None = None
) -> str:
    """Return a data set as in a file.

    Raises:
        DataError: there is no recording that a file can list.
    """
    if not recordings:
        raise DataError("no path of these logs can be listed in a file ($ or unprintable characters); rename them")
    table: dict[str, object] = ({"map": map_file} if map_file else {}) | ({"repair": repair} if repair else {})
    table["recordings"] = recordings
    return toml_text(table, ["Proposed by edp init: the logs with one set of columns."])


def check_files(files: dict[str, str]) -> None:
    """See that what will be written is read as it was meant.

    Raises:
        ConfigError: it is not; nothing was written.
    """
    tables = {name: parse_toml(text, name) for name, text in files.items()}
    # Settings themselves are not built here: their classes import PyTorch, which takes seconds.
    if MAP in tables:
        map_of_table(tables[MAP], MAP)
