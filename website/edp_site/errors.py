"""The error index: every message of EDP with its identifier, cause and remedy, read from the source code."""

from __future__ import annotations

from collections import defaultdict

from edp.cli.error_index import VALUE, ErrorMessage, list_messages
from edp.export.escape import markdown_text

_NO_REMEDY = "The message states what is required."


def errors_page() -> str:
    """Return the page with one table of messages for each part of EDP."""
    parts: dict[str, list[ErrorMessage]] = defaultdict(list)
    for message in list_messages():
        parts[".".join(message.module.split(".")[1:2]) or "edp"].append(message)
    lines = [f"`{VALUE}` stands for a value: a file, a channel, a number.", ""]
    for part, messages in sorted(parts.items()):
        lines += [f"## {part}", "", "| Identifier | Message | Remedy |", "|---|---|---|"]
        lines += [
            f"| `{entry.identifier}` | {markdown_text(entry.cause)} | {markdown_text(entry.remedy) or _NO_REMEDY} |"
            for entry in messages
        ]
        lines.append("")
    return "\n".join(lines)
