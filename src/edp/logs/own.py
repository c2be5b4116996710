"""The facts that EDP writes into its own Parquet and MAT files, as JSON: rate, name, source, meta and channels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from edp.errors import DataError
from edp.recording import Recording
from edp.signals import Channel, Kind


@dataclass(frozen=True)
class OwnFacts:
    """What a file that EDP wrote says about itself; without `rate_hz` the file is someone else's."""

    rate_hz: float | None = None
    name: str | None = None
    source: str = ""
    meta: Mapping[str, Any] = field(default_factory=dict)
    channels: Mapping[str, Channel] = field(default_factory=dict)
    truth: Mapping[str, Channel] = field(default_factory=dict)
    digest: str | None = None
    truth_digest: str | None = None

    def for_log(self) -> dict[str, Any]:
        """What a `RawLog` takes of it."""
        return {
            "rate_hz": self.rate_hz,
            "name": self.name,
            "source": self.source,
            "meta": self.meta,
            "digest": self.digest,
        }


KNOWN = frozenset({"name", "rate_hz", "source", "meta", "channels", "digest", "truth", "truth_digest"})


def facts_text(recording: Recording, truth: Recording | None = None) -> str:
    """A recording's facts as JSON, with those of the channels that the file holds apart."""
    facts = {
        "name": recording.name,
        "rate_hz": recording.rate_hz,
        "source": recording.source,
        "meta": dict(recording.meta),
        "channels": _listed(recording.channels),
        "digest": recording.digest,
    }
    if truth is not None:
        facts |= {"truth": _listed(truth.channels), "truth_digest": truth.digest}
    return json.dumps(facts)


def _listed(channels: Sequence[Channel]) -> list[dict[str, str]]:
    return [{"name": c.name, "unit": c.unit, "kind": str(c.kind), "description": c.description} for c in channels]


def own_facts(text: str, where: str) -> OwnFacts:
    """Read `facts_text` back.

    Raises:
        DataError: the text is damaged.
    """
    try:
        facts = json.loads(text)
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
        return OwnFacts(rate, str(facts["name"]), str(facts["source"]), dict(facts["meta"]), channels, truth, *digests)
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{where}: the facts that EDP wrote into it are damaged ({type(error).__name__}: {error}); "
            "copy or export it again"
        ) from error
