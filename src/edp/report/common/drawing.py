"""One drawing as files, SVG and PNG, in the style of the house: what the pictures of all pages share."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edp.report.common.wording import printable
from edp.storage import make_folder, write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, SOFT, RULE, BLUE, DROPPED = "#26303a", "#66717d", "#e4e8ec", "#0b57d0", "#b4bcc5"
DPI = 150
FORMATS = ("svg", "png")
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 does not have, not even escaped; a channel's name may hold them."""
_STYLE: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same picture on every machine
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": "#c4cbd2",
    "axes.labelcolor": SOFT,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "svg.fonttype": "none",
    "svg.hashsalt": "edp",
    "text.parse_math": False,
}


def write_drawings(folder: str | Path, drawings: Mapping[str, Callable[[Figure], None]]) -> list[Path]:
    """Every drawing in every format, in order, in a folder that is made; the same content gives the same bytes.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    target = make_folder(folder)
    return [path for name, draw in drawings.items() for path in _write(target, name, draw)]


def _write(folder: Path, name: str, draw: Callable[[Figure], None]) -> list[Path]:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    bytes_of, vector = io.BytesIO(), io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(dpi=DPI, layout="constrained")
        bitmap = FigureCanvasAgg(figure)
        draw(figure)
        for text in figure.findobj(Text):
            text.set_text(printable_lines(text.get_text()))
        layout = figure.get_layout_engine()
        if layout is not None:
            layout.execute(figure)
            figure.set_layout_engine("none")  # laid out once, not for every format
        # No program name and no date: equal content gives equal bytes.
        bitmap.print_png(bytes_of, metadata={"Software": None})
        FigureCanvasSVG(figure).print_svg(vector, metadata={"Date": None})
    write_bytes(folder / f"{name}.svg", NOT_XML.sub("\ufffd", vector.getvalue()).encode())
    write_bytes(folder / f"{name}.png", bytes_of.getvalue())
    return [folder / f"{name}.{suffix}" for suffix in FORMATS]


def printable_lines(text: str) -> str:
    """Text that can be drawn, line by line."""
    return "\n".join(map(printable, text.split("\n")))


def file_name(target: str) -> str:
    """A name that any file system takes."""
    # 80 characters stay within the limit of every file system, with a suffix behind them.
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in target)[:80] or "target"
