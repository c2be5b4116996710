"""Data sets: which scenarios to simulate, and running them in several processes."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np

from edp.errors import ConfigError
from edp.recording import Recording
from edp.sim.excitation import EXCITATIONS
from edp.sim.machine_files import load_machine
from edp.sim.simulate import Scenario, SimulationError, simulate

DEFAULT_MIX: Mapping[str, float] = {"isolated": 0.40, "combined": 0.48, "reversals": 0.05, "end_stops": 0.07}
"""Share of the recordings by excitation."""


def plan_data_set(
    machine: str, minutes: float, recordings: int, seed: int, mix: Mapping[str, float] | None = None
) -> tuple[Scenario, ...]:
    """Equally long scenarios, each with its own seed derived from `seed`.

    Args:
        machine: name of a machine file.
        minutes: total length of all recordings.
        recordings: how many.
        seed: seed of the data set.
        mix: share of the recordings by excitation; default `DEFAULT_MIX`.

    Raises:
        ConfigError: a count or length is not positive, or the mix names an unknown excitation.
    """
    shares = dict(DEFAULT_MIX if mix is None else mix)
    if recordings < 1 or not minutes > 0:
        raise ConfigError(f"data set of {recordings} recordings and {minutes} minutes; both must be positive")
    for name, share in shares.items():
        EXCITATIONS[name]
        if not share >= 0:
            raise ConfigError(f"mix: share {share} of '{name}' must not be negative")
    if not sum(shares.values()) > 0:
        raise ConfigError("mix: the shares add up to nothing; give at least one excitation a positive share")
    root = np.random.SeedSequence(seed)
    order_seed, *seeds = root.spawn(recordings + 1)
    names = _apportion(shares, recordings)
    order = np.random.default_rng(order_seed).permutation(recordings)
    label = load_machine(machine).name.lower()
    return tuple(
        Scenario(
            machine=machine,
            excitation=names[order[i]],
            duration_s=round(minutes * 60.0 / recordings, 2),
            seed=int(seeds[i].generate_state(1)[0]),
            name=f"{label}_{i:03d}_{names[order[i]]}",
        )
        for i in range(recordings)
    )


def over_family(scenarios: Sequence[Scenario], count: int, seed: int) -> tuple[Scenario, ...]:
    """The same scenarios on `count` machines of other sizes in turn, see `machine_family`.

    Raises:
        ConfigError: the count is not positive.
    """
    if count < 1:
        raise ConfigError(f"family = {count} machines; at least one is needed")
    return tuple(
        replace(s, machine=f"family-{seed}-{i % count}", name=f"family-{seed}-{i % count}_{i:03d}_{s.excitation}")
        for i, s in enumerate(scenarios)
    )


def _apportion(shares: Mapping[str, float], count: int) -> list[str]:
    """`count` names in proportion to `shares`, by largest remainder."""
    total = sum(shares.values())
    exact = {name: count * share / total for name, share in shares.items()}
    given = {name: int(value) for name, value in exact.items()}
    by_remainder = sorted(exact, key=lambda name: exact[name] - given[name], reverse=True)
    for name in by_remainder[: count - sum(given.values())]:
        given[name] += 1
    return [name for name, n in given.items() for _ in range(n)]


def simulate_many(
    scenarios: Sequence[Scenario], workers: int = 1, on_done: Callable[[Recording], None] | None = None
) -> Iterator[Recording]:
    """Simulate scenarios in `workers` processes and yield their recordings in order.

    The recordings do not depend on the number of workers: each scenario carries its own seed.

    Raises:
        SimulationError: a simulation diverged, or a worker process died.
    """
    source = _serial(scenarios) if workers <= 1 or len(scenarios) <= 1 else _parallel(scenarios, workers)
    for recording in source:
        if on_done is not None:
            on_done(recording)
        yield recording


def _serial(scenarios: Sequence[Scenario]) -> Iterator[Recording]:
    return (simulate(scenario) for scenario in scenarios)


def _parallel(scenarios: Sequence[Scenario], workers: int) -> Iterator[Recording]:
    # Spawned rather than forked: a forked child may inherit locks of threads that do not exist in it.
    context = multiprocessing.get_context("spawn")
    running: deque[tuple[Scenario, Future[Recording]]] = deque()
    with ProcessPoolExecutor(min(workers, len(scenarios)), mp_context=context) as pool:
        waiting = iter(scenarios)
        try:
            for scenario in waiting:
                running.append((scenario, pool.submit(simulate, scenario)))
                if len(running) >= 2 * workers:
                    yield _result(*running.popleft())
            while running:
                yield _result(*running.popleft())
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _result(scenario: Scenario, future: Future[Recording]) -> Recording:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise SimulationError(
            f"a worker process died while '{scenario.label}' was being simulated (out of memory, or stopped from "
            "outside; a calling script needs `if __name__ == '__main__':`); run again with fewer workers"
        ) from error
