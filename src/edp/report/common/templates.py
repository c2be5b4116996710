"""The pages' templates: one environment, where a missing value is an error and text is escaped."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment, Template


def template(name: str) -> Template:
    """The template of a page by its file name; compiled once a process."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    # Here, since every command that may write a page imports this module.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("edp.report", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
