"""Rows of a page that state where a result comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edp.errors import count_of
from edp.wording import count_text, duration, figure, moment

_TEXTS = (
    ("Machine", "machine"), ("Plant", "plant"), ("Twin of the controller", "twin"),
    ("Predictor of the controller", "predictor"), ("Monitor", "monitor"), ("Logs", "logs"), ("Command", "command"),
    ("Version", "edp_version"), ("Seed", "seed"), ("Regime", "regime"), ("Device", "device"), ("Diverged", "diverged"),
)  # fmt: skip


def provenance_rows(provenance: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Return label and text of each stated part of a provenance; empty without a provenance."""
    source = provenance or {}
    contact, data = (_table(source.get(name)) for name in ("ground_data", "data"))
    seconds, parameters, rate = source.get("seconds"), source.get("parameters"), data.get("rate_hz")
    rows: list[tuple[str, Any]] = [("Created", moment(source.get("created")))]
    rows += [(label, source.get(name)) for label, name in _TEXTS]
    rows += [
        ("Training time", duration(seconds) if isinstance(seconds, int | float) else ""),
        ("Parameters", "" if parameters is None else count_text(parameters)),
        ("Data", data.get("source")),
        ("Data with ground contact", contact.get("source")),
        ("Data digest", data.get("digest")),
        ("Rate", f"{figure(rate)} Hz" if isinstance(rate, int | float) else ""),
    ]
    for part in ("train", "validation", "test"):
        facts = _table(data.get(part))
        if facts:
            length = "" if facts.get("hours") is None else f", {_length_text(facts['hours'])}"
            rows.append((part.capitalize(), f"{count_of(facts.get('recordings'), 'recording')}{length}"))
    rows += [(key.replace("_", " ").capitalize(), value) for key, value in _table(source.get("environment")).items()]
    return [(label, str(value)) for label, value in rows if value is not None and value != ""]


def _length_text(hours: float) -> str:
    return f"{figure(hours, 3)} h" if hours >= 0.1 else f"{figure(60 * hours, 3)} min"


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
