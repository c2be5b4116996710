"""Figures of the explanation pages: block diagrams, and charts of the kept benchmark results, as SVG files.

``python -m edp_site.diagrams`` writes them to ``docs/images``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Sequence
from html import escape
from math import log10
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
_STYLE = (
    "text{font:13px system-ui,sans-serif;fill:#1c2333}.s{font-size:11.5px;fill:#3b4560}.b{font-weight:600}"
    ".a,.l{fill:none;stroke:#3b4560;stroke-width:1.5}.a{marker-end:url(#m)}.g{stroke:#d5dae5;stroke-width:1}"
)
_MARKER = (
    '<defs><marker id="m" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
    '<path d="M0 0 8 4 0 8z" fill="#3b4560"/></marker></defs>'
)
_COLOURS = {
    "blue": ("#e8eefc", "#3451a3"),
    "green": ("#e6f4ea", "#2c6e3f"),
    "orange": ("#fdf0e1", "#96530d"),
    "violet": ("#f3e8fb", "#6a2f96"),
    "grey": ("#f1f3f7", "#5a6478"),
}
"""Fill and edge by name."""


class Box(NamedTuple):
    """A rectangle of a diagram: place and size, colour, a title and further lines."""

    x: float
    y: float
    width: float
    height: float
    colour: str
    lines: tuple[str, ...]


class Drawing:
    """An SVG picture.

    Args:
        title: text for readers who do not see the picture.
        width: width in pixels.
        height: height in pixels.
    """

    def __init__(self, title: str, width: int, height: int) -> None:
        self.parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
            f"<title>{escape(title)}</title>",
            f"<style>{_STYLE}</style>",
            _MARKER,
            f'<rect width="{width}" height="{height}" rx="8" fill="#ffffff"/>',
        ]

    def text(self, x: float, y: float, text: str, anchor: str = "middle", style: str = "") -> None:
        """Add a line of text; `style` is a class of the style sheet."""
        styled = f' class="{style}"' if style else ""
        self.parts.append(f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}"{styled}>{escape(text)}</text>')

    def box(self, box: Box) -> None:
        """Add a box, its lines centred, the first one bold."""
        fill, edge = _COLOURS[box.colour]
        self.parts.append(
            f'<rect x="{box.x:g}" y="{box.y:g}" width="{box.width:g}" height="{box.height:g}" rx="6" '
            f'fill="{fill}" stroke="{edge}"/>'
        )
        top = box.y + box.height / 2 - 8 * (len(box.lines) - 1) + 4.5
        for number, line in enumerate(box.lines):
            self.text(box.x + box.width / 2, top + 16 * number, line, style="b" if number == 0 else "")

    def arrow(self, *points: float) -> None:
        """Add an arrow through points, given as x, y, x, y, ..."""
        places = " L".join(f"{x:g} {y:g}" for x, y in zip(points[::2], points[1::2], strict=True))
        self.parts.append(f'<path d="M{places}" class="a"/>')

    def line(self, points: tuple[float, float, float, float], style: str = "l") -> None:
        """Add a line from the first point to the second."""
        x, y, to_x, to_y = points
        self.parts.append(f'<path d="M{x:g} {y:g} L{to_x:g} {to_y:g}" class="{style}"/>')

    def bar(self, x: float, y: float, width: float, colour: str) -> None:
        """Add a horizontal bar of a chart, 16 pixels high."""
        self.parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{max(width, 1.0):.4g}" height="16" rx="2" fill="{_COLOURS[colour][1]}"/>'
        )

    def dot(self, x: float, y: float, colour: str) -> None:
        """Add a point of a chart."""
        self.parts.append(
            f'<circle cx="{x:.5g}" cy="{y:.5g}" r="4.5" fill="{_COLOURS[colour][1]}" fill-opacity="0.75"/>'
        )

    def svg(self) -> str:
        """Return the file."""
        return "\n".join([*self.parts, "</svg>"]) + "\n"


def _diagram(title: str, size: tuple[int, int], boxes: Iterable[Box], arrows: Iterable[Sequence[float]]) -> Drawing:
    drawing = Drawing(title, *size)
    for box in boxes:
        drawing.box(box)
    for points in arrows:
        drawing.arrow(*points)
    return drawing


def _details(name: str) -> Any:
    """Return the details of a kept result."""
    path = ROOT / "benchmarks" / "results" / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))["details"]


def which_model() -> str:
    """Draw the question that each kind of model answers."""
    rows = (
        ("green", "Predictor", "target some samples ahead", "soft sensor, look-ahead, MPC with sensors"),
        ("green", "Twin, learned", "simulation on commands, range of the data", "plant model for control and tests"),
        ("green", "Twin, grey box", "simulation, physical parameters", "plant model, datasheet, other machine"),
        ("violet", "Monitor", "alarms with cause", "condition monitoring, guard of a controller"),
    )
    drawing = Drawing("Four kinds of models, their outputs and typical uses", 860, 290)
    drawing.box(Box(15, 105, 150, 80, "blue", ("Recordings", "channels at one", "rate, SI units")))
    for number, (colour, name, returned, use) in enumerate(rows):
        y = 20 + 65 * number
        drawing.arrow(165, 145, 228, y + 25)
        drawing.box(Box(230, y, 150, 50, colour, (name,)))
        drawing.text(400, y + 22, returned, "start")
        drawing.text(400, y + 40, use, "start", "s")
    return drawing.svg()


def errors_of_the_default() -> str:
    """Draw the test error of the preset auto over the error of the best baseline, for each task of the public sets."""
    tasks = _details("auto_preset")["tasks"]
    titles = list(dict.fromkeys(task["title"] for task in tasks))
    drawing = Drawing("Test error of the preset auto divided by the error of the best of four baselines", 860, 290)
    left, scale = 230.0, 520.0
    for number in range(6):
        ratio = 0.5 + 0.15 * number
        x = left + scale * (ratio - 0.45) / 0.75
        drawing.line((x, 30, x, 240), "g")
        drawing.text(x, 258, f"{ratio:.2f}", style="s")
    one = left + scale * (1.0 - 0.45) / 0.75
    drawing.line((one, 24, one, 240))
    drawing.text(one, 18, "equal to the best baseline", style="s")
    for number, title in enumerate(titles):
        y = 45 + 30 * number
        drawing.text(left - 12, y + 4, title, "end")
        for task in tasks:
            ratio = _value(task) / _reference(task)
            if task["title"] == title:
                drawing.dot(left + scale * (ratio - 0.45) / 0.75, y, "green" if ratio <= 1.0 else "orange")
    drawing.text(
        left + scale / 2, 280, "error over the error of the best baseline, one point per output and horizon", style="s"
    )
    return drawing.svg()


def _value(entry: dict[str, Any]) -> float:
    return float(entry["value"] if "value" in entry else entry["ours"])


def _reference(entry: dict[str, Any]) -> float:
    return float(entry["reference"] if "reference" in entry else entry["rival"])


def automatic_choice() -> str:
    """Draw the steps of the preset auto."""
    boxes = (
        Box(15, 85, 130, 70, "blue", ("Recordings", "training and", "validation part")),
        Box(190, 15, 150, 46, "green", ("linear",)),
        Box(190, 71, 150, 46, "green", ("ensemble",)),
        Box(190, 127, 150, 46, "green", ("recurrent", "only long logs")),
        Box(190, 183, 150, 46, "green", ("pretrained", "if you name one")),
        Box(385, 85, 140, 70, "orange", ("Left-out error", "10 blocks, all", "outputs, horizons")),
        Box(565, 85, 140, 70, "orange", ("Simplest model", "within one standard", "error of the best")),
        Box(745, 85, 100, 70, "violet", ("Test part", "evaluated", "once")),
    )
    arrows = [
        *((145, 120, 188, y) for y in (38, 94, 150, 206)),
        *((340, y, 383, 120) for y in (38, 94, 150, 206)),
        (525, 120, 563, 120),
        (705, 120, 743, 120),
    ]
    title = "The preset auto: candidates are compared on left-out data, the test part is used once"
    return _diagram(title, (860, 245), boxes, arrows).svg()


def expected_errors() -> str:
    """Draw the error ratio stated by the training against the error ratio on the test part."""
    tasks = [task for task in _details("auto_preset")["tasks"] if task.get("skill") is not None]
    drawing = Drawing("Expected and measured error, both relative to the linear model", 860, 400)
    left, bottom, scale = 260.0, 340.0, 300.0

    def place(ratio: float) -> float:
        return scale * (ratio - 0.2) / 1.0

    for number in range(6):
        ratio = 0.2 + 0.2 * number
        drawing.line((left + place(ratio), bottom, left + place(ratio), bottom - scale), "g")
        drawing.line((left, bottom - place(ratio), left + scale, bottom - place(ratio)), "g")
        drawing.text(left + place(ratio), bottom + 18, f"{ratio:.1f}", style="s")
        drawing.text(left - 8, bottom - place(ratio) + 4, f"{ratio:.1f}", "end", "s")
    drawing.line((left, bottom, left + scale, bottom - scale))
    for task in tasks:
        expected = task.get("skill_promised", task.get("skill_expected"))
        near = abs(expected / task["skill"] - 1.0) <= 0.1
        drawing.dot(left + place(expected), bottom - place(task["skill"]), "green" if near else "orange")
    drawing.text(
        left + scale / 2, bottom + 42, "expected: cross-validated error over that of the linear model", style="s"
    )
    drawing.text(left + scale + 20, 60, "measured on the test part", "start")
    drawing.text(left + scale + 20, 78, "green: within 10 % of the expected value", "start", "s")
    drawing.text(left + scale + 20, 94, "orange: further away", "start", "s")
    return drawing.svg()


def grey_box() -> str:
    """Draw the elements of a grey box."""
    boxes = (
        Box(15, 90, 110, 60, "blue", ("Command", "u(t)")),
        Box(165, 90, 140, 60, "green", ("Valve", "dead time, lags,", "play, openings")),
        Box(345, 90, 150, 60, "green", ("Chambers", "p_A, p_B", "oil and free air")),
        Box(535, 90, 130, 60, "green", ("Piston force", "friction, stops")),
        Box(705, 90, 140, 60, "green", ("Load", "inertia, gravity", "of all axes")),
        Box(345, 15, 150, 46, "green", ("Pumps", "demand, power limit")),
        Box(345, 190, 150, 46, "grey", ("Tank", "reliefs, leakage")),
        Box(535, 190, 310, 46, "orange", ("Outputs", "velocity, stroke, pressures")),
    )
    arrows = (
        (125, 120, 163, 120),
        (305, 120, 343, 120),
        (495, 120, 533, 120),
        (665, 120, 703, 120),
        (420, 61, 420, 88),
        (420, 150, 420, 188),
        (775, 150, 775, 188),
        (705, 140, 667, 140),
    )
    drawing = _diagram(
        "Elements of a grey box: valves, pumps, chambers, pistons and the load", (860, 250), boxes, arrows
    )
    drawing.text(235, 38, "pilots of all valves", style="s")
    drawing.arrow(235, 88, 235, 46, 343, 46)
    return drawing.svg()


def false_modules() -> str:
    """Draw how often a study of useless modules confirms one, for two procedures."""
    results = _details("null_calibration")["null"]
    drawing = Drawing(
        "Share of studies without a useful module that confirm one, default and thesis procedure", 860, 300
    )
    left, scale = 300.0, 480.0
    names = {
        "k = 1": "effects differ by session (4 %)",
        "k = 10": "effects differ by session (2 %)",
        "sessions decide": "effects differ by session (8 %)",
        "training sets decide": "effects depend on the training set",
    }
    for number in range(6):
        x = left + scale * 0.2 * number
        drawing.line((x, 20, x, 250), "g")
        drawing.text(x, 268, f"{0.2 * number:.1f}", style="s")
    for number, (model, title) in enumerate(names.items()):
        y = 28 + 56 * number
        drawing.text(left - 12, y + 24, title, "end")
        for offset, method, colour in ((0, "sound", "green"), (20, "thesis: mixed model z, any of 4", "orange")):
            share = results[model][method]["any_false"]
            drawing.bar(left, y + offset, scale * share, colour)
            label = left + max(scale * share, scale * 0.05) + 8  # not across the line of the nominal level
            drawing.text(label, y + offset + 12, f"{share:.3f}", "start", "s")
    nominal = left + scale * 0.05
    drawing.line((nominal, 20, nominal, 250))
    drawing.text(
        left + scale / 2,
        290,
        "green: default procedure, orange: procedure of the thesis, line: nominal level 0.05",
        style="s",
    )
    return drawing.svg()


def monitor_chain() -> str:
    """Draw the way from measured channels to an alarm."""
    boxes = (
        Box(15, 70, 110, 70, "blue", ("Channels", "measured,", "each sample")),
        Box(160, 70, 130, 70, "green", ("Residuals", "measured minus", "expected")),
        Box(325, 70, 130, 70, "green", ("Blocks of 1 s", "mean, spread,", "gain, lag")),
        Box(490, 70, 140, 70, "green", ("Whitening", "by operating point", "of healthy data")),
        Box(665, 70, 90, 70, "green", ("Detectors", "CUSUM")),
        Box(785, 70, 65, 70, "violet", ("Alarm",)),
        Box(160, 180, 295, 46, "grey", ("Healthy sessions, first third", "fit the residuals")),
        Box(490, 180, 265, 46, "grey", ("Other healthy sessions", "set the limit")),
    )
    arrows = (
        (125, 105, 158, 105),
        (290, 105, 323, 105),
        (455, 105, 488, 105),
        (630, 105, 663, 105),
        (755, 105, 783, 105),
        (225, 180, 225, 142),
        (710, 180, 710, 142),
    )
    title = "From channels to alarms; separate healthy sessions fit the residuals and set the limit"
    return _diagram(title, (865, 245), boxes, arrows).svg()


def false_alarms() -> str:
    """Draw the false alarms in 8 h of a monitor in several conditions."""
    details = _details("monitor")
    rows = [
        ("healthy sessions, 24.3 h", details["healthy"]["in_8_h"]),
        ("gravel", details["nuisance"]["gravel"]["in_8_h"]),
        ("oil at 78 degC", details["nuisance"]["oil_78"]["in_8_h"]),
        ("oil at 5 degC", details["nuisance"]["oil_5"]["in_8_h"]),
        ("dry sand", details["nuisance"]["dry_sand"]["in_8_h"]),
        ("other machine, parameters within 1 %", details["nuisance"]["sister_1"]["in_8_h"]),
        ("other machine, parameters within 3 %", details["nuisance"]["sister_3"]["in_8_h"]),
    ]
    drawing = Drawing("False alarms in 8 h of a monitor that was set to one in 8 h, by condition", 860, 300)
    left, scale = 300.0, 130.0
    for power in range(4):
        x = left + scale * (power + 1)
        drawing.line((x, 20, x, 250), "g")
        drawing.text(x, 268, f"{10**power:,}", style="s")
    one = left + scale
    drawing.line((one, 14, one, 250))
    for number, (title, rate) in enumerate(rows):
        y = 26 + 32 * number
        drawing.text(left - 12, y + 12, title, "end")
        width = 0.0 if rate == 0 else scale * (log10(rate) + 1)
        drawing.bar(left, y, width, "green" if rate <= 1.0 else "orange")
        label = left + (scale if 0.0 < rate <= 1.0 else width) + 8  # not across the line of the set rate
        drawing.text(label, y + 12, "none" if rate == 0 else f"{rate:.3g}", "start", "s")
    drawing.text(left + 2 * scale, 290, "false alarms in 8 h, logarithmic; line: one in 8 h, as set", style="s")
    return drawing.svg()


def sandbox() -> str:
    """Draw the layers around the process that reads a log."""
    drawing = Drawing("Layers around the process that reads a log", 860, 280)
    layers = (
        (180, 15, 660, 250, "grey", "Limits: memory, processor time, file size"),
        (205, 50, 610, 205, "blue", "File rules: only the log and Python's folders can be read"),
        (230, 85, 560, 160, "orange", "System-call filter: no sockets, programs or processes"),
        (255, 120, 510, 115, "violet", "Audit hook: last check of Python code"),
    )
    for x, y, width, height, colour, text in layers:
        drawing.box(Box(x, y, width, height, colour, ()))
        drawing.text(x + 14, y + 22, text, "start")
    drawing.box(Box(480, 160, 180, 60, "green", ("Reader", "parses the log")))
    drawing.box(Box(15, 120, 130, 60, "blue", ("Log", "of a stranger")))
    drawing.box(Box(15, 195, 130, 60, "green", ("Command", "checks the result")))
    drawing.arrow(145, 172, 478, 172)
    drawing.arrow(480, 208, 147, 208)
    drawing.text(270, 224, "numbers and names over a pipe", "start", "s")
    return drawing.svg()


def data_flow() -> str:
    """Draw the flow of data through a training."""
    boxes = (
        Box(15, 30, 110, 60, "blue", ("Log file", "logs")),
        Box(160, 30, 120, 60, "blue", ("Recording", "recording")),
        Box(315, 30, 120, 60, "blue", ("Task, split", "data")),
        Box(470, 30, 120, 60, "green", ("Scaler, chunks", "data")),
        Box(625, 30, 100, 60, "green", ("Training", "training")),
        Box(755, 30, 95, 60, "green", ("Bundle", "training")),
        Box(755, 150, 95, 60, "violet", ("Export", "export")),
        Box(600, 150, 120, 60, "orange", ("Evaluation", "evaluation")),
        Box(445, 150, 120, 60, "orange", ("Page", "report")),
        Box(15, 150, 180, 60, "grey", ("Commands, Python", "cli, workflows")),
    )
    arrows = (
        (125, 60, 158, 60),
        (280, 60, 313, 60),
        (435, 60, 468, 60),
        (590, 60, 623, 60),
        (725, 60, 753, 60),
        (802, 90, 802, 148),
        (755, 80, 700, 148),
        (600, 180, 567, 180),
    )
    drawing = _diagram("Flow of data through a training, with the package of each step", (865, 235), boxes, arrows)
    drawing.text(215, 184, "start each step", "start", "s")
    return drawing.svg()


def thesis_phases() -> str:
    """Draw the number of trainings in each phase of the thesis search."""
    phases = (
        ("0 baseline", 180),
        ("1 calibration", 84),
        ("2 module screening", 143),
        ("2.5 planning", 0),
        ("3 confirmation", 600),
        ("4 synthesis", 21),
        ("5 exploration", 161),
        ("6 compression", 18),
    )
    drawing = Drawing("Trainings in each phase of the thesis search with 31 sessions", 860, 280)
    for number, (title, trainings) in enumerate(phases):
        y = 15 + 30 * number
        drawing.text(240, y + 13, title, "end")
        drawing.bar(252, y, 0.8 * trainings, "green")
        drawing.text(262 + 0.8 * trainings, y + 13, str(trainings), "start", "s")
    drawing.text(430, 270, "trainings at most", style="s")
    return drawing.svg()


def simulator() -> str:
    """Draw the parts of the simulator."""
    boxes = (
        Box(15, 90, 130, 60, "blue", ("Operator model", "7 ways of driving")),
        Box(185, 90, 130, 60, "green", ("Levers, pilots", "valves")),
        Box(355, 20, 140, 56, "green", ("Pumps", "demand, power limit")),
        Box(355, 100, 140, 56, "green", ("Cylinders", "oil, friction, stops")),
        Box(355, 180, 140, 56, "green", ("Oil", "temperature")),
        Box(535, 100, 130, 56, "green", ("Linkage, bodies", "rigid, planar")),
        Box(535, 180, 130, 56, "grey", ("Soil", "cutting, heap, heel")),
        Box(705, 100, 145, 56, "orange", ("Sensors, bus", "noise, lag, latency")),
        Box(705, 180, 145, 56, "violet", ("Recording", "at 100 Hz")),
    )
    arrows = (
        (145, 120, 183, 120),
        (315, 110, 353, 60),
        (315, 125, 353, 128),
        (425, 76, 425, 98),
        (495, 128, 533, 128),
        (665, 128, 703, 128),
        (425, 180, 425, 158),
        (600, 180, 600, 158),
        (777, 156, 777, 178),
    )
    drawing = _diagram("Parts of the simulator, from the operator to the recording", (865, 255), boxes, arrows)
    drawing.arrow(600, 100, 600, 8, 80, 8, 80, 88)
    drawing.text(215, 24, "sees strokes, speeds and the ground", style="s")
    return drawing.svg()


FIGURES: dict[str, Callable[[], str]] = {
    "which_model": which_model,
    "errors_of_the_default": errors_of_the_default,
    "automatic_choice": automatic_choice,
    "expected_errors": expected_errors,
    "grey_box": grey_box,
    "false_modules": false_modules,
    "monitor_chain": monitor_chain,
    "false_alarms": false_alarms,
    "sandbox": sandbox,
    "data_flow": data_flow,
    "thesis_phases": thesis_phases,
    "simulator": simulator,
}
"""Functions that draw a figure, by the name of its file in ``docs/images``."""


def main(folder: Path) -> None:
    """Write all figures into a folder."""
    for name, draw in FIGURES.items():
        (folder / f"{name}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images")
