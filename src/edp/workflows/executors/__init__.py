"""Who does the work: this process, processes of this machine, or a Ray cluster; an executor a file.

`edp search` gives them trainings, the commands of a fleet units of work (`edp.workflows.executors.units`).
"""

from edp.workflows.executors.base import EXECUTORS as EXECUTORS
from edp.workflows.executors.base import Executor as Executor
from edp.workflows.executors.base import Workforce as Workforce
from edp.workflows.executors.cluster import RayPool as RayPool
from edp.workflows.executors.in_process import InProcess as InProcess
from edp.workflows.executors.processes import LocalPool as LocalPool
