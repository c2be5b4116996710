"""Plant models in free run: trained on a data set, compared with baselines, and run along a log."""

from edp.workflows.twin.forecast_logs import ForecastLogs, forecast_logs
from edp.workflows.twin.judge_twin import evaluate_twin
from edp.workflows.twin.rollout import Rollout, RolloutRequest, rollout_log
from edp.workflows.twin.train_twin import TrainedTwin, train_twin

__all__ = [
    "ForecastLogs",
    "Rollout",
    "RolloutRequest",
    "TrainedTwin",
    "evaluate_twin",
    "forecast_logs",
    "rollout_log",
    "train_twin",
]
