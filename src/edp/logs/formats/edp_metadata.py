"""Metadata that EDP writes into its Parquet and MAT files, as JSON: rate, name, source, meta and channels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from edp.errors import DataError
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage.reading import Table


@dataclass(frozen=True)
class EdpMetadata:
    """Metadata of a file written by EDP; without `rate_hz` the file has another origin."""

    rate_hz: float | None = None
    name: str | None = None
    source: str = ""
    meta: Mapping[str, object] = field(default_factory=dict)
    channels: Mapping[str, Channel] = field(default_factory=dict)
    truth: Mapping[str, Channel] = field(default_factory=dict)
    digest: str | None = None
    truth_digest: str | None = None

    def to_log_metadata(self) -> Table:
        """Return the metadata for a `RawLog`."""
        return {
            "rate_hz": self.rate_hz,
            "name": self.name,
            "source": self.source,
            "meta": self.meta,
            "digest": self.digest,
        }


LONGEST_FACTS = 1 << 24
"""Maximum number of characters of the metadata. A thousand channels take 150,000."""
LONGEST_TEXT = 4096
"""Maximum number of characters of a name, a source or a description."""
DEEPEST = 32
"""Maximum nesting depth of lists and tables. EDP's own data have four levels."""
KNOWN = frozenset({"name", "rate_hz", "source", "meta", "channels", "digest", "truth", "truth_digest"})


def facts_text(recording: Recording, truth: Recording | None = None) -> str:
    """Return the metadata of a recording as JSON, with separate entries for the ground truth."""
    facts = {
        "name": recording.name,
        "rate_hz": recording.rate_hz,
        "source": recording.source,
        "meta": dict(recording.meta),
        "channels": _list_channels(recording.channels),
        "digest": recording.digest,
    }
    if truth is not None:
        facts |= {"truth": _list_channels(truth.channels), "truth_digest": truth.digest}
    return json.dumps(facts)


def _list_channels(channels: Sequence[Channel]) -> list[dict[str, str]]:
    return [{"name": c.name, "unit": c.unit, "kind": str(c.kind), "description": c.description} for c in channels]


def parse_edp_metadata(text: str, where: str) -> EdpMetadata:
    """Read `facts_text` back.

    Raises:
        DataError: the text is damaged.
    """
    try:
        if len(text) > LONGEST_FACTS:
            raise ValueError(f"they have {len(text)} characters, at most {LONGEST_FACTS} are read")
        facts = json.loads(text)
        if not isinstance(facts, dict):
            raise ValueError(f"they are a {type(facts).__name__}")
        strange = sorted(set(facts) - KNOWN)
        if strange:
            # A damaged key must not pass for a file that states no digest.
            raise ValueError(f"it states {', '.join(map(repr, strange))}, which this version does not know")
        rate = float(facts["rate_hz"])
        if not (math.isfinite(rate) and rate > 0):
            raise ValueError(f"rate_hz is {rate}")
        channels, truth = (
            {str(e["name"]): Channel(str(e["name"]), Kind(e["kind"]), str(e["description"])) for e in entries}
            for entries in (facts["channels"], facts.get("truth", []))
        )
        # Files of earlier versions state no digest.
        digests = (facts.get("digest"), facts.get("truth_digest"))
        if any(digest is not None and not isinstance(digest, str) for digest in digests):
            raise ValueError("its digest is no text")
        name, source = (str(facts[key]) for key in ("name", "source"))
        _check_texts([name, source, *(text for c in [*channels.values(), *truth.values()] for text in _texts(c))])
        _check_depth(facts["meta"])
        return EdpMetadata(rate, name, source, dict(facts["meta"]), channels, truth, *digests)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{where}: the facts that EDP wrote into it are damaged ({type(error).__name__}: {str(error)[:200]}); "
            "copy or export it again"
        ) from error


def _texts(channel: Channel) -> tuple[str, str]:
    return channel.name, channel.description


def _check_texts(texts: Sequence[str]) -> None:
    longest = max(map(len, texts), default=0)
    if longest > LONGEST_TEXT:
        raise ValueError(f"a text in them has {longest} characters, at most {LONGEST_TEXT} are read")


def _check_depth(value: Any) -> None:
    """Refuse values nested so deeply that writing them again would overflow the stack."""
    # Level by level: a recursive walk would end in the very error that is looked for.
    level = [value]
    for _ in range(DEEPEST):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise ValueError(f"they are nested more than {DEEPEST} deep")
