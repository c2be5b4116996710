"""The task on the channels that the recordings have: what is missing of the usual ones is derived where it can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from edp.config.experiment import FeatureSettings
from edp.data.features import FEATURE_SETS, Derived
from edp.errors import ConfigError
from edp.signals import Kind
from edp.workflows.auto.settings import AutoSettings

USUAL = "FG2"
"""The feature set that is taken without a word where the recordings have its channels."""
MOST_LISTED = 20
"""Channels that a message lists."""
AXES = range(1, 4)
SOURCES = {
    **{f"CylVels_{axis}": (f"CylStroke_{axis}", Kind.VELOCITY) for axis in AXES},
    **{f"CylAcc_{axis}": (f"CylVels_{axis}", Kind.ACCELERATION) for axis in AXES},
}
"""Of which channel a channel is the derivative, and its kind."""


def fit_to_channels(settings: AutoSettings, names: Sequence[str], where: str) -> tuple[AutoSettings, list[str]]:
    """Settings whose task the recordings can answer, and what was changed, in sentences.

    Args:
        settings: of the run.
        names: channels of the recordings.
        where: they come from.

    Raises:
        ConfigError: a target is no channel of the recordings, and cannot be derived.
    """
    task = settings.task
    notes: list[str] = []
    if task.features == USUAL and not set(FEATURE_SETS[USUAL].inputs) <= set(names):
        features, notes = _of_these(names)
        task = replace(task, features=features)
    derived = () if isinstance(task.features, str) else task.features.derived
    channels = {*names, *(entry.name for entry in (*derived, *task.derived_targets))}
    absent = [target for target in task.targets if target not in channels]
    if absent:
        listed = ", ".join(names[:MOST_LISTED]) + (", ..." if len(names) > MOST_LISTED else "")
        raise ConfigError(
            f"task.targets: {', '.join(absent[:MOST_LISTED])} is no channel of '{where}', which has {listed}; "
            f"name what to predict, for example --set 'task.targets=[\"{names[-1]}\"]'"
        )
    return replace(settings, task=task), notes


def _of_these(names: Sequence[str]) -> tuple[str | FeatureSettings, list[str]]:
    """The usual features as far as they are there or can be derived; all channels where others are missing."""
    usual = FEATURE_SETS[USUAL]
    missing = [name for name in usual.inputs if name not in names]
    derived = [
        Derived(name, SOURCES[name][0], "derivative", SOURCES[name][1])
        for name in missing
        if name in SOURCES and SOURCES[name][0] in names
    ]
    if not derived:
        return "all", []  # a machine of another kind
    notes = [f"Derived by EDP: {', '.join(f'{one.name} from {one.source}' for one in derived)}."]
    lost = [name for name in missing if name not in {one.name for one in derived}]
    if lost:
        notes.append(f"Of the usual channels {', '.join(lost)} are not there: every channel of the logs is read.")
        return FeatureSettings(name="all", channels=tuple(names), derived=tuple(derived)), notes
    channels = tuple(name for name in usual.channels if name in names)
    hidden = tuple(dict.fromkeys(one.source for one in derived if one.source not in channels))
    return FeatureSettings(name=USUAL, channels=channels, derived=(*usual.derived, *derived), hidden=hidden), notes
