"""Coverage of a source's recordings; free of training libraries, whose import takes most of a command's start."""

from __future__ import annotations

from collections.abc import Sequence

from edp.data.coverage import Coverage, cover
from edp.data.spectrum import LAGS
from edp.data.splits import SPLITS
from edp.logs.source import DataSource


def coverage(source: DataSource, inputs: Sequence[str] = (), split: str = "") -> Coverage:
    """Return the coverage of a data set, see `edp.data.coverage`.

    Args:
        source: source of the recordings.
        inputs: channels that command, where neither names nor kinds tell.
        split: name of a split with its usual settings, to say how far tests lie from training.

    Raises:
        EdpError: the recordings cannot be read as they are, or do not command or move anything; an unknown split.
    """
    chosen = SPLITS[split]() if split else None
    recordings = source.read()
    return cover(recordings, inputs, None if chosen is None else chosen.split(recordings, LAGS))
