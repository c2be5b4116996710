"""Who does the work: this process, processes of this machine, or a Ray cluster; an executor a file.

`edp search` gives them trainings, the commands of a fleet units of work (`edp.jobs.units`).
"""

from edp.jobs.base import EXECUTORS as EXECUTORS
from edp.jobs.base import Executor as Executor
from edp.jobs.base import Workforce as Workforce
from edp.jobs.cluster import RayPool as RayPool
from edp.jobs.in_process import InProcess as InProcess
from edp.jobs.processes import LocalPool as LocalPool
