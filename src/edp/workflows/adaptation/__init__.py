"""On-board adaptation of a run: fitted on its recordings, replayed on others."""

from edp.ir.rls import AdaptationSpec
from edp.workflows.adaptation.export_follower import export_follower
from edp.workflows.adaptation.fit import adapt, fit_adaptation
from edp.workflows.adaptation.replay import BINS, Replay, Replayed, motion_s, replay, replay_run

__all__ = [
    "BINS",
    "AdaptationSpec",
    "Replay",
    "Replayed",
    "adapt",
    "export_follower",
    "fit_adaptation",
    "motion_s",
    "replay",
    "replay_run",
]
