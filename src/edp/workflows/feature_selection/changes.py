"""Changes over the lags that a screening found, as derived channels of a feature set."""

from __future__ import annotations

from dataclasses import replace

from edp.config.experiment import FeatureSettings
from edp.data.features import MAX_LAG, Derived
from edp.data.screening import ScreeningResult
from edp.data.screening.proposal import CLEAR
from edp.recording import Recording


def add_changes(
    settings: FeatureSettings, screening: ScreeningResult, recording: Recording, name: str
) -> FeatureSettings:
    """Return the set with a change of each channel over the span that the screening gives for it.

    A channel that leads a target clearly changes over its lead: what it did since then has yet to arrive. A target
    changes over the horizon, which is how far its past must be continued. Other channels get none.

    Args:
        settings: the set.
        screening: lag curves and horizon.
        recording: one of those that were screened, for the kinds of its channels.
        name: name of the set with changes.
    """
    added = []
    for channel in settings.channels:
        ticks = _lead(screening, channel) or (screening.horizon if channel in screening.targets else 0)
        if not 1 <= ticks <= MAX_LAG:
            continue
        kind = recording.channels[recording.index(channel)].kind
        seconds = round(ticks / screening.rate_hz, 9)
        added.append(Derived(f"change_{channel}", channel, "change", kind, seconds))
    return replace(settings, name=name, derived=settings.derived + tuple(added))


def _lead(screening: ScreeningResult, channel: str) -> int:
    """Return the lead in ticks of a channel before its most dependent target; 0 without a clear lead."""
    leads = [
        curve
        for curve in screening.lags
        if curve.channel == channel
        and channel not in screening.targets
        and curve.certain
        and not curve.at_edge
        and abs(curve.value) >= CLEAR
        and curve.best < 0
    ]
    return -max(leads, key=lambda curve: abs(curve.value)).best if leads else 0
