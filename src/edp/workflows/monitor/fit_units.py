"""Jobs of a fit as units of work, whose results stay in the run folder, so that a stopped fit continues."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from edp.jobs import Workers
from edp.jobs.packing import pack, unpack
from edp.jobs.workers import UNITS, UnitResult, WorkUnit
from edp.monitor.detectors import DETECTORS
from edp.monitor.fitting import FittedPart
from edp.monitor.monitor_file import kind_of, read_network, write_network
from edp.monitor.residuals.base import RESIDUALS, ResidualSource, SourceParts
from edp.monitor.session_blocks import SessionBlocks
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path
from edp.training.blas import one_blas_thread
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle
from edp.workflows.monitor.dictionary import DrawnFaults

PLAIN: Mapping[str, type[Any]] = {one.__name__: one for one in (SessionBlocks, FittedPart, DrawnFaults)}
"""Results that are stored field by field."""
NOTHING, NETWORK, SOURCE = "nothing", "network", "source"


@dataclass(frozen=True)
class _StoredSource:
    """A source of residuals, or a network alone, as a unit returns it; networks lie in the run folder."""

    plain: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]
    networks: Mapping[str, Mapping[str, str]]


@dataclass(eq=False)
class UnitMap:
    """Calls the functions of a fit as units of work.

    Attributes:
        workers: who does them; nodes see the run folder under the same path.
        run: run folder.
        key: key of the run.
        seconds: processor time of units computed by other processes or an earlier command.
    """

    workers: Workers
    run: Path
    key: str
    seconds: float = 0.0
    calls: int = field(default=0, init=False)

    @property
    def is_elsewhere(self) -> bool:
        """Whether other processes do the units."""
        return not self.workers.are_alone

    def __call__(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
        """Yield ``function(job)`` of each job."""
        self.calls += 1
        name = f"{function.__module__}:{function.__qualname__}"
        run = full_path(self.run)
        units = []
        for number, job in enumerate(jobs):
            arguments = {"run": self.key, "function": name, "call": self.calls, "number": number, "label": job.label}
            where = {"function": name, "job": job, "run": str(run)}
            units.append(WorkUnit(f"{__name__}:do_unit", job.label, arguments, "", where))
        for result in self.workers.map_in_order(units, folder=run / UNITS):
            if self.is_elsewhere or not result.is_new:
                self.seconds += result.seconds
            # Decoded where it was computed in this process, too: a continued fit has the same bits.
            yield _decode(result, run)


@one_blas_thread()
def do_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState | dict[str, Any]:
    """Run a unit of a fit, a function of this package."""
    module, _, function = where["function"].partition(":")
    return _encode(getattr(importlib.import_module(module), function)(where["job"]), Path(where["run"]))


def _encode(result: object, run: Path) -> WithState | dict[str, Any]:
    """Return a result in the form of a unit."""
    if result is None:
        return {"kind": NOTHING}
    if isinstance(result, Bundle | TwinBundle):
        return WithState({"kind": NETWORK}, pack(_StoredSource({}, {}, {NETWORK: write_network(run, result)})))
    if isinstance(result, ResidualSource):
        parts = result.parts()
        networks = {name: write_network(run, bundle) for name, bundle in parts.bundles.items()}
        stored = _StoredSource(dict(parts.plain), dict(parts.arrays), networks)
        return WithState({"kind": SOURCE, "source": kind_of(result)}, pack(stored))
    if type(result).__name__ not in PLAIN:
        raise TypeError(f"a result of type {type(result).__name__} is not stored")
    return WithState({"kind": type(result).__name__}, pack(result))


def _decode(result: UnitResult, run: Path) -> object:
    """Return the result of a unit."""
    kind, content = result.values["kind"], result.content or b""
    if kind == NOTHING:
        return None
    if kind in PLAIN:
        return unpack(content, PLAIN[kind], DETECTORS.values())
    stored = unpack(content, _StoredSource)
    networks = {name: read_network(run, entry) for name, entry in stored.networks.items()}
    if kind == NETWORK:
        return networks[NETWORK]
    return RESIDUALS[result.values["source"]].source.from_parts(SourceParts(stored.plain, stored.arrays, networks))
