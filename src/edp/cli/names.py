"""Names of commands and options in earlier versions, and the names that replace them.

Earlier names are read for one release: `rewrite` replaces them in a command line before it is parsed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

COMMANDS: Mapping[tuple[str, ...], tuple[str, ...]] = {
    ("inspect",): ("data", "check"),
    ("screen",): ("data", "screen"),
    ("animate",): ("data", "animate"),
    ("forecast",): ("data", "add-forecasts"),
    ("store", "check"): ("data", "store", "verify"),
    ("store",): ("data", "store"),
    ("finetune",): ("train", "finetune"),
    ("pretrain",): ("train", "pretrain"),
    ("distil",): ("compress", "distil"),
    ("quantise",): ("compress", "quantise"),
    ("footprint",): ("compress", "estimate"),
    ("parity",): ("verify",),
    ("replay",): ("adapt", "replay"),
    ("identify",): ("calibrate",),
    ("control",): ("loop", "run"),
    ("tune",): ("loop", "tune"),
}
"""Words of a command in earlier versions, and its words now."""
COMPRESS = ("distil", "quantise", "search", "estimate")
"""Commands of the group `compress`. Any other word is the run of `edp compress RUN`, the search of earlier versions."""


class Renamed(NamedTuple):
    """The present name of an option.

    Attributes:
        name: name of the option.
        unit: unit that a value of the earlier option lacks; empty for values that are unchanged.
    """

    name: str
    unit: str = ""


_SEARCH = {"--study": Renamed("--out"), "--seconds": Renamed("--max-seconds"), "--memory": Renamed("--max-memory")}
_TIME_BUDGET = {"--minutes": Renamed("--time-budget", "min")}
_MAX_HOURS = {"--at-most": Renamed("--max-hours")}
OPTIONS: Mapping[tuple[str, ...], Mapping[str, Renamed]] = {
    ("simulate",): {"--minutes": Renamed("--duration", "min")},
    ("data", "animate"): {"--seconds": Renamed("--duration", "s"), "--start": Renamed("--from")},
    ("data", "check"): _MAX_HOURS,
    ("data", "screen"): _MAX_HOURS,
    ("data", "add-forecasts"): {
        "--ahead": Renamed("--horizon"),
        "--answer": Renamed("--channel"),
        "--gain": Renamed("--observer-gain"),
    },
    ("train",): _TIME_BUDGET,
    ("train", "run"): _TIME_BUDGET,
    ("twin",): _TIME_BUDGET,
    ("search",): _SEARCH,
    ("search", "run"): _SEARCH,
    ("evaluate",): _TIME_BUDGET | _MAX_HOURS,
    ("rollout",): {"--seconds": Renamed("--rollout-seconds")},
    ("live",): {"--free-s": Renamed("--rollout-seconds")},
    ("compress", "distil"): {"--further": Renamed("--unlabelled")},
    ("compress", "quantise"): {"--ticks": Renamed("--calibration-samples")},
    ("compress", "search"): {"--again": Renamed("--reopen-test-set")},
    ("export",): {"--to": Renamed("--format"), "--forms": Renamed("--formats")},
    ("verify",): {"--form": Renamed("--format"), "--ticks": Renamed("--samples")},
    ("loop", "run"): {"--seeds": Renamed("--loops")},
    ("loop", "tune"): {
        "--seeds": Renamed("--evaluation-loops"),
        "--loops": Renamed("--tuning-loops"),
        "--on": Renamed("--tuning-plant"),
    },
    ("monitor", "fit"): _TIME_BUDGET,
    ("runs",): {"--most": Renamed("--max-runs")},
}
"""Options of earlier versions by the present words of the command."""
FOCUS, SIMULATION = "--focus", "simulation"


@dataclass(frozen=True)
class Rewritten:
    """A command line with present names.

    Attributes:
        words: the words after `edp`.
        notices: one sentence for each earlier name.
    """

    words: list[str]
    notices: list[str]


def rewrite(words: Sequence[str]) -> Rewritten:
    """Return a command line with the present names of its commands and options.

    `edp train DATA --focus simulation` becomes `edp twin DATA`.

    Args:
        words: the words after `edp`.
    """
    rest, notices = list(words), []
    named = next((old for old in COMMANDS if tuple(rest[: len(old)]) == old), None)
    if named is not None:
        rest[: len(named)] = COMMANDS[named]
        notices.append(f"edp {' '.join(named)} is now edp {' '.join(COMMANDS[named])}")
    elif rest[:1] == ["compress"] and len(rest) > 1 and not {"--help", *COMPRESS}.intersection(rest[1:2]):
        rest.insert(1, "search")
        notices.append("edp compress RUN is now edp compress search RUN")
    if rest[:1] == ["train"]:
        rest = _choose_focus(rest)
    command = next((tuple(rest[:length]) for length in (2, 1) if tuple(rest[:length]) in OPTIONS), ())
    renamed = OPTIONS.get(command, {})
    for position, word in enumerate(rest):
        if word == "--":
            break
        option, sign, value = word.partition("=")
        if option not in renamed:
            continue
        new = renamed[option]
        rest[position] = new.name + (f"={_add_unit(value, new.unit)}" if sign else "")
        if not sign and position + 1 < len(rest):
            rest[position + 1] = _add_unit(rest[position + 1], new.unit)
        notices.append(f"{option} is now {new.name}" + (f", with a unit such as 5{new.unit}" if new.unit else ""))
    return Rewritten(rest, notices)


def _add_unit(value: str, unit: str) -> str:
    """Return the value of an earlier option, a number, with its unit; any other text is unchanged."""
    return value + unit if re.fullmatch(r"[-+0-9.e]+", value) else value


def _choose_focus(words: list[str]) -> list[str]:
    """Return the command line of `edp twin` for `--focus simulation`; other words unchanged."""
    for position, word in enumerate(words):
        if word == f"{FOCUS}={SIMULATION}":
            return ["twin", *words[1:position], *words[position + 1 :]]
        if word == FOCUS and words[position + 1 : position + 2] == [SIMULATION]:
            return ["twin", *words[1:position], *words[position + 2 :]]
    return words
