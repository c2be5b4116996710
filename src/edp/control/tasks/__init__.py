"""Control tasks: reference, limits and score; one module and one registration per task."""

from edp.control.tasks.base import TASKS, ControlTask, TaskSpec, draw_task
from edp.control.tasks.corners import CornerPath as CornerPath
from edp.control.tasks.dig import DigCycle as DigCycle
from edp.control.tasks.grade import Grade as Grade
from edp.control.tasks.level import LevelBucket as LevelBucket
from edp.control.tasks.point import PointToPoint as PointToPoint

__all__ = ["TASKS", "ControlTask", "TaskSpec", "draw_task"]
