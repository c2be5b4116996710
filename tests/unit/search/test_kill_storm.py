"""Kill -9 of workers and coordinators: nothing lost, nothing trained twice, the same result."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from edp.storage.ledger import Ledger, read_records

pytestmark = pytest.mark.processes

STUDY = """
import sys
from edp.storage.ledger import Ledger, TrainingIdentity
from edp.jobs.base import Job, complete
from edp.jobs.processes import LocalPool

def identity(seed):
    facts = {"code": "c", "data": "d", "environment": {"threads": "1"}}
    return TrainingIdentity("trainings_of_tests:train", {"sleep": 0.1}, {}, seed, 1, **facts)

study, log, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
if __name__ == "__main__":
    with Ledger(study) as ledger, LocalPool(2) as pool:
        print("begun", *pool.processes(), flush=True)
        complete(ledger, pool, [Job(identity(seed), {"log": log, "study": study}) for seed in range(count)])
        print("digest", ledger.digest(), flush=True)
"""


def workers_of(pid):
    """Children of a process."""
    found = []
    for task in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = task.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(task.parent.name))
    return found


def gone(pids):
    return not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_workers_and_coordinators_are_killed_and_nothing_is_lost(tmp_path):
    script = tmp_path / "study.py"
    script.write_text(STUDY)
    count = 14
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])

    def start(study):
        command = [sys.executable, str(script), str(tmp_path / study), str(tmp_path / f"{study}.log"), str(count)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": paths})

    quiet = start("quiet")
    wanted = quiet.communicate()[0].splitlines()[-1]
    assert quiet.returncode == 0
    draw = random.Random(0)
    log = tmp_path / "storm.log"
    for goal in (3, 6, 9):
        study = start("storm")
        victims = 0
        while study.poll() is None and (not log.exists() or log.read_text().count("end") < goal):
            time.sleep(0.02)
            children = workers_of(study.pid)
            if victims < 2 and children and log.exists() and log.read_text().count("start") > goal - 2:
                os.kill(draw.choice(children), signal.SIGKILL)
                victims += 1
        children = workers_of(study.pid)
        study.kill()
        study.communicate()
        until = time.monotonic() + 120
        while not gone(children):
            assert time.monotonic() < until, "workers outlive their coordinator"
            time.sleep(0.01)
    assert 0 < len(read_records(tmp_path / "storm")[0]) < count
    last = start("storm")
    assert last.communicate()[0].splitlines()[-1] == wanted
    ends = [line.split()[1] for line in log.read_text().splitlines() if line.startswith("end")]
    assert sorted(map(int, set(ends))) == list(range(count))
    assert "twice" not in log.read_text(), "a training began whose record was there"
    before = log.read_text()
    done = start("storm")
    assert done.communicate()[0].splitlines()[-1] == wanted
    assert log.read_text() == before, "a finished search trains nothing"
    with Ledger(tmp_path / "storm") as ledger:
        assert len(ledger) == count
        assert not ledger.damaged
