"""Feature sets as TOML files, written by `edp data screen` or by the user and read by `task.features`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from edp.data.features import FeatureSet
from edp.errors import ConfigError
from edp.storage import read_toml

SUFFIX = ".toml"


def is_set_file(features: object) -> bool:
    """Return whether a setting `task.features` names a file."""
    return isinstance(features, str) and features.endswith(SUFFIX)


def read_set_table(path: str | Path) -> dict[str, object]:
    """Read the table of a feature-set file. Missing keys are empty; a missing name is replaced by the file name.

    The names of its keys and the values are checked where the settings are.

    Raises:
        ConfigError: the file cannot be read, or is not TOML.
    """
    source = Path(path)
    advice = (
        "; task.features is a name (FG1, FG2, all), a table, or the path of a feature-set file, which in a settings "
        "file is relative to that file"
    )
    table = read_toml(source, f"the feature set '{source}'", ConfigError, advice)
    return {"name": source.stem, "channels": [], "derived": [], "hidden": []} | table


def set_text(
    features: FeatureSet, head: Sequence[str] = (), why: Mapping[str, str] | None = None, tail: Sequence[str] = ()
) -> str:
    """Format a feature set as TOML that `read_set_table` can read.

    Args:
        features: the set.
        head: lines of comment on top.
        why: a comment for each channel that has one.
        tail: lines of comment at the end.
    """
    why = why or {}
    lines = [*(_comment(line) for line in head), f"name = {_text(features.name)}", "", "channels = ["]
    width = max((len(_text(name)) for name in features.channels), default=0) + 1
    for name in features.channels:
        entry = f"{_text(name)},"
        lines.append(f"    {entry:<{width}}  {_comment(why[name])}" if name in why else f"    {entry}")
    lines += ["]", f"hidden = [{', '.join(_text(name) for name in features.hidden)}]"]
    for derived in features.derived:
        facts = {"name": derived.name, "source": derived.source, "how": derived.how, "kind": str(derived.kind)}
        lines += ["", "[[derived]]", *(f"{key} = {_text(value)}" for key, value in facts.items())]
        lines += [] if derived.span_s is None else [f"span_s = {derived.span_s!r}"]
    lines += ["", *(_comment(line) for line in tail)] if tail else []
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    """Return a basic TOML string. JSON escapes are valid TOML, except for the delete character."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")


def _comment(line: str) -> str:
    """Return a TOML comment line; control characters, which TOML forbids in comments, become spaces."""
    return ("# " + "".join(c if c.isprintable() else " " for c in line)).rstrip()
