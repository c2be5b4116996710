"""Rows of a page that state the origin of a result."""

from __future__ import annotations

from typing import Any

from edp.errors import count_of
from edp.settings.provenance import Provenance
from edp.wording import count_text, duration, figure, moment

_TEXTS = (
    ("Machine", "machine"), ("Plant", "plant"), ("Twin of the controller", "twin"),
    ("Predictor of the controller", "predictor"), ("Monitor", "monitor"), ("Logs", "logs"), ("Command", "command"),
    ("Version", "edp_version"), ("Seed", "seed"), ("Regime", "regime"), ("Device", "device"), ("Diverged", "diverged"),
)  # fmt: skip


def provenance_rows(provenance: Provenance | None) -> list[tuple[str, str]]:
    """Return label and text of each stated part of a provenance; empty without a provenance."""
    if provenance is None:
        return []
    data, more, seconds = provenance.origin, provenance.more, provenance.seconds
    contact, parameters = more.get("ground_data"), more.get("parameters")
    texts = {"command": provenance.command, "edp_version": provenance.edp_version, "seed": provenance.seed, **more}
    rows: list[tuple[str, Any]] = [("Created", moment(provenance.created))]
    rows += [(label, texts.get(name)) for label, name in _TEXTS]
    rows += [
        ("Training time", "" if seconds is None else duration(seconds)),
        ("Parameters", "" if parameters is None else count_text(parameters)),
        ("Data", data.source),
        ("Data with ground contact", contact.get("source") if isinstance(contact, dict) else None),
        ("Data digest", data.digest),
        ("Rate", "" if data.rate_hz is None else f"{figure(data.rate_hz)} Hz"),
    ]
    for name in ("train", "validation", "test"):
        part = data.part(name)
        if part is not None:
            rows.append((name.capitalize(), f"{count_of(part.recordings, 'recording')}, {_length_text(part.hours)}"))
    rows += [(key.replace("_", " ").capitalize(), value) for key, value in provenance.environment.items()]
    return [(label, str(value)) for label, value in rows if value is not None and value != ""]


def _length_text(hours: float) -> str:
    return f"{figure(hours, 3)} h" if hours >= 0.1 else f"{figure(60 * hours, 3)} min"
