"""Pages of results: sections of text, tables and figures, which one template writes as one offline HTML file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from markupsafe import Markup

from edp.report.common.chart import Chart
from edp.report.common.picture import write_pictures
from edp.report.common.templates import asset, json_text, stylesheet, template
from edp.storage import make_folder, write_bytes
from edp.table import Table
from edp.wording import unbroken

DRAWING = ("figure_axes.js", "figure_marks.js", "figures.js")
"""Scripts that draw figures from their plotly description. Plotly itself has 4.8 MB and takes a second to load."""


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of text, or of HTML if the text is `Markup`.

    Attributes:
        text: sentences.
        kind: ``aid`` explains what follows, ``quiet`` is a remark, ``missing`` says what there is not.
    """

    text: str
    kind: Literal["aid", "quiet", "missing"] = "aid"


@dataclass(frozen=True)
class Points:
    """A list of sentences, with a sentence above them if `lead` is not empty."""

    lines: Sequence[str]
    lead: str = ""


@dataclass(frozen=True)
class Terms:
    """List of terms, each with its explanation.

    Attributes:
        rows: name and text, or `Points` in place of a long text.
        in_columns: whether the texts are figures, which need little room.
    """

    rows: Sequence[tuple[str, str | Points]]
    in_columns: bool = False


@dataclass(frozen=True)
class Fold:
    """Parts that a reader unfolds.

    Attributes:
        summary: always shown.
        parts: shown on demand.
        is_open: whether they are shown from the beginning.
        is_printed: whether paper shows them, too.
    """

    summary: str
    parts: Sequence[Part | None]
    is_open: bool = False
    is_printed: bool = True


@dataclass(frozen=True)
class Subsection:
    """Parts of a section that belong together, under a heading of their own if `title` is not empty."""

    parts: Sequence[Part | None]
    title: str = ""


Part = str | Markup | Paragraph | Points | Terms | Fold | Subsection | Table | Chart
"""Part of a page. Plain text explains the next part; `Markup` is HTML."""


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes:
        name: anchor of the section on the page.
        title: heading of the section.
        parts: parts of the section, from top to bottom. The page omits None, tables and lists without rows, and
            sections, folds and groups that contain only explaining text.
        link: short title in the navigation; the title if empty.
    """

    name: str
    title: str
    parts: Sequence[Part | None]
    link: str = ""


@dataclass(frozen=True, kw_only=True)
class Page:
    """A page of results.

    Attributes:
        title: subject of the page, such as the name of a run.
        kind: kind of page, in words, for the title of the window.
        about: further data above the headline.
        headline: the result in a sentence.
        verdict: sentences below the headline.
        tiles: value, unit and meaning of each key figure.
        sections: sections in order; empty ones are omitted.
        provenance: label and text of each line of the last section; none without lines.
        footer: a sentence at the end.
        styles: files with its style.
    """

    title: str
    kind: str
    headline: str
    sections: Sequence[Section]
    about: Sequence[str] = ()
    verdict: Sequence[str] = ()
    tiles: Sequence[tuple[str, str, str]] = ()
    provenance: Sequence[tuple[str, str]] = ()
    footer: str = ""
    styles: tuple[str, ...] = ("page.css",)

    def html(self) -> str:
        """Return the text of the page, with style and scripts, and without anything to load."""
        provenance = Section("provenance", "Provenance", [Terms(self.provenance)])
        sections = [section for section in (*self.sections, provenance) if has_content(section)]
        charts = [part for section in sections for part in _parts_within(section) if isinstance(part, Chart)]
        drawn = {}
        if charts:
            # Here, since every command that may write a page imports this module, and plotly takes half a second.
            from edp.report.common.interactive import plots

            drawn = plots(charts)
        return template("page.html.jinja").render(
            page=self,
            shown=_render_parts,
            headline=unbroken(self.headline),
            sections=sections,
            plots=drawn,
            specs=json_text([plot.spec() for plot in drawn.values()]),
            style=Markup(stylesheet(*self.styles)),
            drawing=Markup("\n".join(asset(name) for name in DRAWING)),
            script=Markup(asset("page.js")),
        )

    def write(self, target: str | Path) -> Path:
        """Write the page and return its path.

        Raises:
            StorageError: the page cannot be written.
        """
        write_bytes(Path(target), self.html().encode("utf-8", "replace"))
        return Path(target)


def has_content(part: Part | Section | None) -> bool:
    """Return whether a part of a page shows more than an explanation of what follows."""
    if isinstance(part, Section | Fold | Subsection):
        return any(map(has_content, part.parts))
    if isinstance(part, Table | Terms):
        return bool(part.rows)
    if isinstance(part, Points):
        return bool(part.lines)
    return part is not None and type(part) is not str and not (isinstance(part, Paragraph) and part.kind == "aid")


def _render_parts(parts: Sequence[Part | None]) -> list[Part]:
    return [part for part in parts if part is not None and (isinstance(part, str | Paragraph) or has_content(part))]


def _parts_within(part: Section | Fold | Subsection) -> Iterator[Part]:
    """Yield all parts, including the parts of folds and subsections."""
    for inner in part.parts:
        if isinstance(inner, Fold | Subsection):
            yield from _parts_within(inner)
        elif inner is not None:
            yield inner


def write_report(page: Page, target: Path, tables: Sequence[Table], pictures: Sequence[Chart]) -> Path:
    """Write a page with its tables (``tables/NAME.csv``, ``tables/NAME.md``) and pictures (``pictures/*``) next to it.

    Raises:
        StorageError: a file cannot be written.
    """
    page.write(target)
    folder = make_folder(target.parent / "tables")
    for table in tables:
        write_bytes(folder / f"{table.name}.csv", table.csv().encode("utf-8", "replace"))
        write_bytes(folder / f"{table.name}.md", table.markdown().encode("utf-8", "replace"))
    if pictures:
        write_pictures(target.parent / "pictures", pictures)
    return target
