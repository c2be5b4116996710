"""A monitor that is fitted within seconds, for tests of what is made of it."""

from __future__ import annotations

from collections.abc import Sequence

from edp.config.monitor import load_monitor_experiment
from edp.monitor.monitor import Monitor
from edp.recording import Recording
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import fit_to_recordings


def fitted_monitor(sessions: Sequence[Recording] = ()) -> Monitor:
    """Of the small rig: two kinds of residuals, and all detectors with a form in C.

    Args:
        sessions: healthy ones of 2,000 ticks; by default those of the rig.
    """
    watches = ",".join(
        f"{{detector={{kind={kind}}},memory_s={memory}}}"
        for kind, memory in (
            *(('"ewma",weight=0.5', 0.2), ('"cusum",slack=0.5', 1.0)),
            *(('"glr",window=5', 0.2), ('"separate_cusums",slack=3.0', 0.2)),
        )
    )
    watches += ',{detector={kind="separate_cusums",slack=0.5},view="own",reserve=1.2}'
    sensors = '{kind="virtual_sensors",members=2,units=4,rows=2000,lags_s=[0.05,0.1]}'
    changes = [
        *("chain.block_s=0.2", "chain.settle_s=1.0", "chain.folds=2"),
        f"chain.watches=[{watches}]",
        f'residuals=[{sensors},{{kind="balances"}}]',
    ]
    experiment = load_monitor_experiment(None, changes, {"hours_per_false_alarm": 0.02, "minutes": 0.02})
    return fit_to_recordings(sessions or rig_sessions(12, 2000, seed=1), experiment).monitor
