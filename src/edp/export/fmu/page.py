"""``documentation/index.html`` of an FMU."""

from __future__ import annotations

from edp.export.escape import xml_text
from edp.export.fmu.describe import About

RULES = (
    "A step reads the inputs that were set before it; the predictions can be read after it. No output depends on an "
    "input at the same communication point, so there are no algebraic loops.",
    "Every step must be {step} s long and begin where the one before ended: another length is refused with an error "
    "and a message. Whole steps that were left out are held: the last accepted inputs are fed again, up to five in a "
    "row.",
    "An input that is NaN, infinite, far beyond its range or was never set makes a tick bad: it is held as well, the "
    "step returns a warning, and valid is false. Without anything to hold there is no prediction: outputs keep their "
    "values, status is 3.",
    "After a reset, and after more than five held ticks in a row, status is 1 and valid is false for {window} steps.",
    "States can be saved, restored and serialised; what follows is the same to the last bit. Instances share nothing.",
    "From the sources of several FMUs in one program: define FMI2_FUNCTION_PREFIX or FMI3_FUNCTION_PREFIX as {name}_ "
    "for each. With EDP_FMI_HEADERS the standard's own headers are used.",
)

PLANT = (
    "It is a plant model: with the commands alone set it runs free on its own answers. To read a measured value "
    "instead, set it, and its flag (the input whose name ends in _measured) to 1; it must always be finite.",
    "Start it with {window} measured steps, which form its memory. Without any it rests at the means of its training "
    "data.",
)

MONITOR = (
    RULES[0].replace("predictions", "verdicts"),
    RULES[1].replace("the last accepted inputs are fed again", "ticks without any measurement"),
    "An input that is NaN, infinite, far beyond its range or was never set is missing at that tick: its last value "
    "stands in, residuals that judge or read it are silent, the step returns a warning, and valid is false.",
    "What a block says is computed during the next block. After an alarm the detectors begin anew.",
    *RULES[4:],
)


def page(about: About) -> bytes:
    """Return the documentation page: inputs, outputs and rules."""
    window = about.facts.get("window", "")
    monitor = "monitor_hash" in about.facts
    texts = MONITOR if monitor else RULES + (PLANT if "plant" in about.facts else ())
    rules = "".join(f"<li>{xml_text(t.format(step=about.step_s, window=window, name=about.name))}</li>" for t in texts)
    rows = "".join(
        f"<tr><td>{xml_text(entry.name)}</td><td>{entry.causality}</td>"
        f"<td>{xml_text(entry.unit) if entry.form == 'real' else ''}</td><td>{xml_text(entry.description)}</td></tr>"
        for entry in about.listed
    )
    derivatives = (
        "Directional derivatives are those of the predictions of a step made now, by the inputs as they are set."
        if about.derivatives
        else "Directional derivatives are not provided."
    )
    name, title = xml_text(about.name), xml_text(about.title)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{name}</title></head><body>\n'
        f"<h1>{name}</h1>\n<p>{title}, {about.rate_hz:g} Hz, in SI units. {derivatives}</p>\n<ul>{rules}</ul>\n"
        f"<table><tr><th>variable</th><th>causality</th><th>unit</th><th>what it is</th></tr>{rows}</table>\n"
        "</body></html>\n"
    ).encode()
