"""Plant models that run free: trained on a data set, judged beside floors, and run along a log."""

from edp.workflows.twin.judge_twin import evaluate_twin
from edp.workflows.twin.rollout import Rollout, rollout_log
from edp.workflows.twin.train_twin import TrainedTwin, train_twin

__all__ = ["Rollout", "TrainedTwin", "evaluate_twin", "rollout_log", "train_twin"]
