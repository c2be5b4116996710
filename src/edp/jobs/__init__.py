"""Executors of jobs, one per file: this process, a pool of local processes, or a Ray cluster.

`edp search` submits trainings, commands over a fleet submit units of work (`edp.jobs.units`).
"""

from edp.jobs.base import EXECUTORS as EXECUTORS
from edp.jobs.base import Executor as Executor
from edp.jobs.base import Workforce as Workforce
from edp.jobs.cluster import RayPool as RayPool
from edp.jobs.in_process import InProcess as InProcess
from edp.jobs.processes import LocalPool as LocalPool
