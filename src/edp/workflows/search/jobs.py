"""Requests of a search as jobs for an executor; the identity holds all that determines a result."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from edp.jobs.base import START, Job
from edp.storage.ledger import TrainingIdentity, WithState, code_version, read_state
from edp.storage.provenance import environment
from edp.workflows.search.arms import Arm
from edp.workflows.search.smaller import make_smaller
from edp.workflows.search.trainings import TrainingRequest, experiment_of, train_part


def job_of(
    order: TrainingRequest, data: str, threads: int = 1, seconds: float | None = None, memory_mb: float | None = None
) -> Job:
    """Return the job of a request.

    Args:
        order: training to run.
        data: hash of the recordings that it names; where they lie is no part of the key.
        threads: number of threads, regardless of the settings; the pool pins as many.
        seconds: cap on its time.
        memory_mb: cap on the memory of its process.

    Raises:
        ConfigError: settings that cannot be built, or an unknown machine.
    """
    # Threads are part of a result: sums change their order with them.
    arm = Arm(order.settings).with_value("training.threads", threads)
    config: dict[str, object] = {"settings": arm.tables, "updates": order.updates}
    sessions = {"train": list(order.train), "judged": list(order.judged)}
    # One epoch leaves these out, so that keys of earlier studies stay what they were.
    if order.epochs > 1:
        config |= {"epochs": order.epochs, "patience": order.patience}
        sessions["validation"] = list(order.validation)
    if order.until is not None:
        config["until"] = order.until
    if order.recipe is not None:
        config["recipe"] = order.recipe
    if arm.get("model.physics"):
        physics = experiment_of(order).model.physics
        config["machine"] = None if physics is None else physics.digest()  # its file may change, and its name stays
    identity = TrainingIdentity(
        f"{__name__}:train",
        config,
        sessions,
        order.seed,
        order.epochs,
        code_version(),
        data,
        _environment(threads),
    )
    return Job(identity, {"source": dict(order.source)}, seconds, memory_mb)


_environment = cache(environment)  # looking up versions takes as long as a record


def train(identity: TrainingIdentity, where: Mapping[str, Any]) -> object:
    """Do the order, and return its result, with the state from which a later part continues.

    Where the file of a state cannot be read any more, it is trained from the beginning.

    Raises:
        EdpError: see `edp.workflows.search.trainings.train_part`.
    """
    plain = {**identity.config, **identity.split, "seed": identity.seed, "source": where["source"]}
    part = train_part if identity.config.get("recipe") is None else make_smaller
    trained = part(TrainingRequest.from_json(plain), read_state(where[START]) if START in where else None)
    return trained.result if trained.state is None else WithState(trained.result, trained.state)
