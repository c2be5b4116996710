"""What the checks and the generator read of a Markdown page: fences, headings with their anchors, links."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

_FENCE = re.compile(r"^ {0,3}(`{3,}|~{3,})[ \t]*([^\s`]*)")
_HEADING = re.compile(r"^(#{1,6})[ \t]+(.+?)(?:[ \t]+#+)?[ \t]*$")
_OWN_ANCHOR = re.compile(r"[ \t]*\{[ \t]*#([\w-]+)[ \t]*\}$")
_CODE = re.compile(r"(`+)(?:(?!\1).)*?\1")
_LINK = re.compile(
    r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(\s*<?([^()\s>]*(?:\([^()\s]*\))?[^()\s>]*)>?(?:\s+\"[^\"]*\")?\s*\)"
)
_ELEMENT = re.compile(r"<[^>]*?\s(?:id|name)=\"([^\"]+)\"")
_REFERENCE = re.compile(r"<(?:a|img|source)\s[^>]*?(?:href|src)=\"([^\"]+)\"")


class Fence(NamedTuple):
    """A block of code: its language, the line of its first row of code, and the code."""

    language: str
    line: int
    code: str


class Heading(NamedTuple):
    """A heading: depth, text, line, and the anchor that GitHub gives it."""

    depth: int
    text: str
    line: int
    anchor: str


class Link(NamedTuple):
    """A link: its line and its target as written."""

    line: int
    target: str


def fences(text: str) -> Iterator[Fence]:
    """Return the fenced blocks of a page."""
    lines = text.splitlines()
    for first, last, language in _fence_spans(lines):
        yield Fence(language, first + 2, "\n".join(lines[first + 1 : last]) + "\n")


def _fence_spans(lines: list[str]) -> Iterator[tuple[int, int, str]]:
    opened: tuple[int, str, str] | None = None
    for number, line in enumerate(lines):
        match = _FENCE.match(line)
        if opened is None:
            if match:
                opened = (number, match[1], match[2])
        elif match and match[1].startswith(opened[1]) and not match[2]:
            yield opened[0], number, opened[2]
            opened = None
    if opened is not None:
        yield opened[0], len(lines), opened[2]


def prose(text: str) -> list[str]:
    """Return the lines of a page, with empty lines in place of fenced blocks."""
    lines = text.splitlines()
    for first, last, _ in list(_fence_spans(lines)):
        lines[first : last + 1] = [""] * len(lines[first : last + 1])
    return lines


def anchor_of(title: str) -> str:
    """Return the anchor that GitHub gives a heading with this text."""
    plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title)
    plain = plain.replace("`", "").replace("*", "").strip().lower()
    return re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")


def headings(text: str) -> list[Heading]:
    """Return the headings of a page; the second heading with the same text has the anchor ``text-1``, and so on."""
    found: list[Heading] = []
    seen: Counter[str] = Counter()
    for number, line in enumerate(prose(text), 1):
        if match := _HEADING.match(line):
            title, own = match[2], _OWN_ANCHOR.search(match[2])
            anchor = own[1] if own else anchor_of(title)
            count = seen[anchor]
            seen[anchor] += 1
            found.append(
                Heading(len(match[1]), _OWN_ANCHOR.sub("", title), number, f"{anchor}-{count}" if count else anchor)
            )
    return found


def anchors(text: str) -> set[str]:
    """Everything on a page that a link may lead to."""
    return {heading.anchor for heading in headings(text)} | set(_ELEMENT.findall("\n".join(prose(text))))


def links(text: str) -> list[Link]:
    """Return the links and pictures of a page outside of code."""
    found = []
    for number, line in enumerate(prose(text), 1):
        plain = _CODE.sub(lambda match: match[0] if "](" in match[0] and "[" not in match[0] else "code", line)
        found += [Link(number, match[3]) for match in _LINK.finditer(plain)]
        found += [Link(number, target) for target in _REFERENCE.findall(plain)]
    return found


def code_spans(text: str) -> Iterator[tuple[int, str]]:
    """Line and content of the code within sentences."""
    for number, line in enumerate(prose(text), 1):
        for match in _CODE.finditer(line):
            yield number, match[0].strip("`").strip()


def with_links(text: str, replace: dict[str, str]) -> str:
    """Return a page with replaced link targets; code is unchanged."""
    lines, shown = text.splitlines(), prose(text)

    def renamed(match: re.Match[str]) -> str:
        target = replace.get(match[3], match[3])
        return match[0].replace(f"]({match[3]}", f"]({target}", 1)

    def renamed_element(match: re.Match[str]) -> str:
        return match[0].replace(f'"{match[1]}"', f'"{replace.get(match[1], match[1])}"')

    for number, line in enumerate(lines):
        if shown[number]:
            lines[number] = _REFERENCE.sub(renamed_element, _LINK.sub(renamed, line))
    return "\n".join(lines) + "\n"
