"""Work divided among processes of this machine or the nodes of a Ray cluster.

Commands map a function over units of work (`edp.jobs.workers`); `edp search` submits trainings to an executor.
"""

from edp.jobs.base import Executor as Executor
from edp.jobs.cluster import RayPool as RayPool
from edp.jobs.processes import LocalPool as LocalPool
from edp.jobs.workers import IN_PROCESS as IN_PROCESS
from edp.jobs.workers import Workers as Workers
