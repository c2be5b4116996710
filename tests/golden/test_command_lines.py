"""Arguments and options of every command are those of the file beside: scripts of users rely on them.

Write the file again with `python tests/golden/test_command_lines.py` after a change that users are told of.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.main import get_command

from edp.cli import app

FILE = Path(__file__).with_name("command_lines.json")


def _leaves(node: Any, words: tuple[str, ...] = ()) -> dict[str, list[Any]]:
    below = getattr(node, "commands", None)
    if below is None:
        return {" ".join(words): node.params}
    return {
        name: parameters for part, inner in below.items() for name, parameters in _leaves(inner, (*words, part)).items()
    }


def _facts(parameter: Any) -> dict[str, Any]:
    default = parameter.default
    facts = {
        "kind": parameter.param_type_name,
        "required": parameter.required,
        "several": getattr(parameter, "multiple", False) or parameter.nargs == -1,
        "switch": getattr(parameter, "is_flag", False),
        "default": default if isinstance(default, bool | int | float | str) else None,
    }
    return {name: value for name, value in facts.items() if value not in (False, None)}


def command_lines() -> dict[str, dict[str, Any]]:
    """Return the facts of each parameter by command and by the words that a user types."""
    return {
        name: {" ".join([*one.opts, *one.secondary_opts]): _facts(one) for one in parameters if one.name != "help"}
        for name, parameters in _leaves(get_command(app)).items()
    }


def test_command_lines_stay_as_they_are():
    assert command_lines() == json.loads(FILE.read_text())


if __name__ == "__main__":
    FILE.write_text(json.dumps(command_lines(), indent=1, sort_keys=True) + "\n")
