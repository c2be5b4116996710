"""What the workers of these tests are told to do; each start and each end is a line in a log."""

import os
import signal
import time
from pathlib import Path

from edp.errors import ConfigError, NotFiniteError
from edp.storage.ledger import WithState, known, read_state


def _note(where, word, identity):
    if "log" in where:
        with Path(where["log"]).open("a") as log:
            log.write(f"{word} {identity.seed} {os.getpid()}\n")


def train(identity, where):
    """A training of `config.sleep` seconds whose score follows from its seed."""
    _note(where, "start", identity)
    if "study" in where and known(where["study"], identity.key):
        _note(where, "twice", identity)
    time.sleep(identity.config.get("sleep", 0.0))
    _note(where, "end", identity)
    return {"score": 1 / (1 + identity.seed), "threads": os.environ.get("OMP_NUM_THREADS")}


def killed(identity, where):
    """Its process is killed in its first `config.times` starts."""
    _note(where, "start", identity)
    starts = Path(where["log"]).read_text().count(f"start {identity.seed} ")
    if starts <= identity.config["times"]:
        print("last words")
        os.kill(os.getpid(), signal.SIGKILL)
    return {"score": 0.5}


def hog(identity, where):
    """Takes `config.mb` of memory."""
    _note(where, "start", identity)
    held = bytearray(int(identity.config["mb"] * 2**20))
    held[::4096] = b"x" * len(held[::4096])
    time.sleep(20.0)
    return {"held": len(held)}


def goes_on(identity, where):
    """Adds its seed to the state that it goes on from, where it gets one."""
    _note(where, "start", identity)
    before = read_state(where["start"]) if "start" in where else b""
    return WithState({"before": before.decode()}, before + b" %d" % identity.seed)


def tells_of_a_state(identity, where):
    """Whether the state that it gets is whole."""
    return {"whole": read_state(where["start"]) is not None}


def raises(identity, where):
    """Ends as `config.how` says."""
    _note(where, "start", identity)
    how = identity.config["how"]
    if how == "error":
        raise ValueError("no such optimiser")
    if how == "user":
        raise ConfigError("give at least 1 epoch")
    if how == "diverged":
        raise NotFiniteError("the loss is nan in epoch 3")
    if how == "memory":
        raise MemoryError("512 GB")
    if how == "exit":
        raise SystemExit(3)
    return {"nan": {"score": float("nan")}, "inf": {"scores": [1.0, float("-inf")]}, "list": [1]}[how]
