"""Escaping of text from bundles in generated files: one function per language, portable names, templates.

Names, descriptions and titles come from whoever made the bundle. Whatever of them goes into C, MATLAB, XML, HTML, YAML,
Python or Markdown passes the function of that language here, and `fill` refuses text that did not.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from html import escape as html_escape
from importlib import resources
from string import Template

from edp.errors import ExportError

LONGEST_TEXT = 500
"""Maximum number of characters of a description or title. C99 guarantees 4,095 characters per line; an escape takes up
to ten.
"""
LONGEST_NAME = 120
"""Maximum number of characters of a name in XML, YAML and tables: in octal escapes, a C string of at most 1,920
characters.
"""
C_SIGNIFICANT = 63
"""Number of significant characters of an identifier in C99, and maximum length of a MATLAB name."""
# A name must not be empty in any language.
UNNAMED = "unnamed"
"""Replacement of an empty name."""

C_WORDS = frozenset(
    re.findall(
        r"\w+",
        """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while _Bool _Complex
    _Imaginary bool true false asm fortran alignas alignof and and_eq bitand bitor catch char8_t char16_t char32_t class
    compl concept const_cast consteval constexpr constinit co_await co_return co_yield decltype delete dynamic_cast
    explicit export friend mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public
    reinterpret_cast requires static_assert static_cast template this thread_local throw try typeid typename using
    virtual wchar_t xor xor_eq
    """,
    )
)
"""Keywords of C99 and C++20."""
MATLAB_WORDS = frozenset(
    re.findall(
        r"\w+",
        """
    break case catch classdef continue else elseif end for function global if otherwise parfor persistent return spmd
    switch try while arguments enumeration events methods properties do until unwind_protect unwind_protect_cleanup
    end_try_catch end_unwind_protect endclassdef endenumeration endevents endfor endfunction endif endmethods endparfor
    endproperties endspmd endswitch endwhile __FILE__ __LINE__
    """,
    )
)
"""Keywords of MATLAB and GNU Octave."""


class Code(str):
    """Text in the language of the file that it goes into: made by an emitter, or escaped by a function of this file."""

    __slots__ = ()


def visible(text: object, most: int = LONGEST_TEXT) -> str:
    r"""Return text as one line of printable characters.

    Control and format characters (bidirectional ones too), line separators, lone surrogates, and white space other than
    a blank become ``\uXXXX``; what is longer than `most` characters ends in ``...``.
    """
    whole = str(text)
    # The cut keeps the whole line within the limit, ellipsis included.
    cut = whole if len(whole) <= most else f"{whole[: most - 3]}..."
    return cut if cut.isprintable() else "".join(c if c.isprintable() else _code_point(c) for c in cut)


def _code_point(character: str) -> str:
    number = ord(character)
    return f"\\u{number:04x}" if number < 0x10000 else f"\\U{number:08x}"


def c_comment(text: object) -> Code:
    """Return text within ``/* */``: no end or beginning of a comment, no trigraph, and no backslash at its end."""
    # Twice: a run of three question marks leaves a pair after the first replacement. Trigraphs begin with two.
    plain = visible(text).replace("??", "? ?").replace("??", "? ?").replace("*/", "* /").replace("/*", "/ *")
    return Code(plain + " " if plain.endswith("\\") else plain)


def c_string(text: object) -> Code:
    """Return a C literal; quotes, backslashes, question marks and characters outside ASCII are octal escapes.

    A lone surrogate, which has no UTF-8, becomes a question mark.
    """
    data = str(text).encode("utf-8", "replace")
    # Octal digits end after three; hexadecimal ones would swallow the letters that follow.
    plain = (chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in data)
    return Code(f'"{"".join(plain)}"')


def matlab_comment(text: object) -> Code:
    """Return text behind ``%``: of one line, which cannot begin or end a block of comments behind other text."""
    return Code(visible(text))


def matlab_string(text: object) -> Code:
    r"""Return a MATLAB literal in single quotes; control characters become ``\uXXXX``."""
    # MATLAB ends a string with one quote and writes it with two.
    return Code("'" + visible(text, 10 * LONGEST_TEXT).replace("'", "''") + "'")


def python_literal(text: object) -> Code:
    """Return a Python literal in ASCII."""
    # `ascii` escapes every character that could end the literal.
    return Code(ascii(str(text)))


def xml_text(text: object) -> Code:
    r"""Return text between tags of XML or HTML, or within quotes in one.

    Characters that XML cannot hold become ``\uXXXX``.
    """
    return Code(html_escape(visible(text)))


def yaml_scalar(text: object) -> Code:
    """Return a double-quoted YAML scalar in ASCII that is read back unchanged; a lone surrogate becomes U+FFFD."""
    # YAML readers refuse lone surrogates.
    whole = str(text).encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    return Code('"' + "".join(c if " " <= c <= "~" and c not in '"\\' else _yaml_point(c) for c in whole) + '"')


def _yaml_point(character: str) -> str:
    return f"\\{character}" if character in '"\\' else _code_point(character)


def markdown_text(text: object) -> Code:
    """Return text within a line or a cell of a table of Markdown: no markup, no HTML, no link, no end of the cell."""
    plain = re.sub(r"[\\`*\[\]|~$#!]|(?<![^\W_])_|_(?![^\W_])", r"\\\g<0>", visible(text))
    plain = plain.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # A bare address becomes a link in many readers.
    return Code(plain.replace("://", ":\\//").replace("www.", "www\\."))


def c_names(names: Iterable[str], most: int) -> list[str]:
    """Return the names as the ends of C identifiers, different ones for different names, of at most `most` characters.

    What is no ASCII letter, digit or underscore becomes an underscore; see `distinct`.
    """
    return distinct((re.sub(r"\W", "_", name, flags=re.ASCII) for name in names), most)


def matlab_names(names: Iterable[str]) -> list[str]:
    """Return the names as names of variables, fields and bus elements of MATLAB, different ones for different names.

    As `c_names`; ``x`` comes before what does not begin with a letter, and before keywords of MATLAB, C and C++.
    """
    plain = (re.sub(r"\W", "_", name, flags=re.ASCII) for name in names)
    words = MATLAB_WORDS | C_WORDS
    return distinct((n if re.match("[A-Za-z]", n) and n not in words else f"x{n}" for n in plain), C_SIGNIFICANT)


def shown_names(names: Iterable[str]) -> list[str]:
    """Return the names in XML, parameters and tables: `visible`, of at most `LONGEST_NAME` characters, all different.

    Runs of white space become a blank.
    """
    return distinct((visible(" ".join(name.split()), LONGEST_NAME) for name in names), 10 * LONGEST_NAME)


def distinct(names: Iterable[str], most: int) -> list[str]:
    """Return unique names of at most `most` characters.

    An empty name is `UNNAMED`, duplicates get ``_1``, ``_2`` and so on.
    """
    distinct_names: list[str] = []
    used_names: set[str] = set()
    tried: dict[str, int] = {}
    for name in (label[:most] or UNNAMED for label in names):
        number = tried.get(name, 0)
        while (candidate := _add_number(name, number, most)) in used_names:
            number += 1
        tried[name] = number + 1
        used_names.add(candidate)
        # The number of the next trial is remembered: thousands of equal names take linear time.
        distinct_names.append(candidate)
    return distinct_names


def _add_number(name: str, number: int, most: int) -> str:
    ending = f"_{number}" if number else ""
    return name[: most - len(ending)] + ending


def fill(template: str, values: Mapping[str, object]) -> Code:
    """Fill in the blanks of a template.

    Args:
        template: template with blanks in the form of `string.Template`.
        values: numbers, `Code`, or text of letters, digits, blanks and ``_.,:+-`` only, which is harmless everywhere.

    Raises:
        ExportError: other text, which nothing has escaped.
    """
    for name, value in values.items():
        if not isinstance(value, Code | int | float) and not _HARMLESS(str(value)):
            raise ExportError(
                f"the value of '{name}' is {visible(ascii(value), LONGEST_NAME)}, which is not escaped for the file it "
                # Refusal is the last line of defence: text of a bundle's author must not become code.
                "goes into; nothing was written. Export another bundle, and report this one"
            )
    return Code(Template(template).substitute(values))


def package_text(path: str) -> str:
    """Return the text of a file of `edp.export`, such as ``c/runtime/edp_runtime.c``."""
    return resources.files("edp.export").joinpath(path).read_text(encoding="utf-8")


def fill_file(path: str, values: Mapping[str, object]) -> Code:
    """Fill in the blanks of a file of `edp.export`; see `fill`."""
    return fill(package_text(path), values)


_HARMLESS: Callable[[str], re.Match[str] | None] = re.compile(r"[A-Za-z0-9_ .,:+\-]*").fullmatch
