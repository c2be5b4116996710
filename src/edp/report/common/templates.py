"""Templates, styles and scripts of pages: one environment, where a missing value is an error and text is escaped."""

from __future__ import annotations

import json
import re
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from edp.errors import count_of
from edp.wording import unit_text

if TYPE_CHECKING:
    from jinja2 import Environment, Template


_HEX = re.compile(r"#[0-9a-fA-F]{6}")


def template(name: str) -> Template:
    """Return the template of a page by its file name; it is compiled once per process."""
    return _environment().get_template(name)


def asset(name: str) -> str:
    """Return the text of a file that pages carry with them: a script or a style."""
    return resources.files("edp.report").joinpath("assets", name).read_text(encoding="utf-8")


def stylesheet(*names: str) -> str:
    """Return the style of a page: the colours of all pages, light and dark, then these files."""
    return "\n".join(asset(name) for name in ("palette.css", *names))


def json_text(value: Any) -> Markup:
    """Return plain values as JSON that cannot end its script element, for any names."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def themed(colour: str) -> str:
    """Return a colour (``#26303a``) as the palette's variable for this colour, which has another value in the dark."""
    return f"var(--c{colour[1:].lower()}, {colour})" if _HEX.fullmatch(colour) else colour


@cache
def _environment() -> Environment:
    # Here, since every command that may write a page imports this module.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("edp.report", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["themed"] = themed
    environment.filters["kind"] = lambda part: type(part).__name__
    environment.filters["unit_text"] = unit_text
    environment.globals["count_of"] = count_of
    return environment
