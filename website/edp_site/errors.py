"""The error index: every message of EDP with its identifier, cause and remedy, read from the source code."""

from __future__ import annotations

from collections import defaultdict

from edp.cli.error_index import VALUE, ErrorMessage, list_messages
from edp.export.escape import markdown_text

_INTRODUCTION = f"""# Error index

The command line prints an identifier after each error message, such as `[E-98d64a]`. Find the identifier on this page
with the browser's search. `{VALUE}` stands for a value: a file, a channel, a number. The identifier changes only if the
wording of the message changes.

Exit code 1 means an error that you can repair, 2 a wrong command line, 75 "try again later", and 130 Ctrl-C.
"""
_NO_REMEDY = "The message states what is required."


def errors_page() -> str:
    """Return the page with one table of messages for each part of EDP."""
    parts: dict[str, list[ErrorMessage]] = defaultdict(list)
    for message in list_messages():
        parts[".".join(message.module.split(".")[1:2]) or "edp"].append(message)
    lines = [_INTRODUCTION]
    for part, messages in sorted(parts.items()):
        lines += [f"## {part}", "", "| Identifier | Message | Remedy |", "|---|---|---|"]
        lines += [
            f"| `{entry.identifier}` | {markdown_text(entry.cause)} | {markdown_text(entry.remedy) or _NO_REMEDY} |"
            for entry in messages
        ]
        lines.append("")
    return "\n".join(lines)
