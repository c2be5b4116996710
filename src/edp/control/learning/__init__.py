"""Tasks of the bucket tip as environments of Gymnasium: for learning, on the simulator, a twin or an FMU."""

from edp.control.learning.environments import TaskEnvironment, VectorTaskEnvironment
from edp.control.learning.policy import PolicyController
from edp.control.learning.registration import register_tasks
from edp.control.learning.reward import RewardWeights
from edp.control.learning.spec import LearningSpec

__all__ = [
    "LearningSpec",
    "PolicyController",
    "RewardWeights",
    "TaskEnvironment",
    "VectorTaskEnvironment",
    "register_tasks",
]
register_tasks()
