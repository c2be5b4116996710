"""Dictionary of a monitor: simulated effect of each fault on the residuals, at each size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, StorageError
from edp.monitor.diagnosis.causes import FaultClass, class_of
from edp.monitor.diagnosis.evidence import Scatter
from edp.monitor.diagnosis.structure import Confusion
from edp.monitor.stored_arrays import read_stored, write_stored
from edp.settings.results import read_part
from edp.storage.arrays import ArrayRule, checked_arrays
from edp.storage.paths import is_there

Array = NDArray[np.float64]
FILE, SCHEMA = "dictionary", 1
MAX_CLASSES, MAX_SUMMARIES, MAX_SIGNATURES = 5_000, 5_000, 50_000
ARRAYS = {
    "signatures": ArrayRule((2, "signatures", "features")),
    "owner": ArrayRule(("signatures",)),
    "sizes": ArrayRule(("signatures",)),
    "mean": ArrayRule(("features",)),
    "lasting": ArrayRule(("features",)),
    "passing": ArrayRule(("features",)),
    "matrix": ArrayRule(("features", "features")),
}
NUMBERS = ("changing", "temperature", "strange")


@dataclass(frozen=True, eq=False)
class Dictionary:
    """Signatures of faults in the directions of `Scatter`.

    Attributes:
        summaries: names of the monitor's summaries, in order.
        classes: the faults.
        scatter: scatter of healthy sessions.
        signatures: mean change of the directions by a fault of a size, at its onset and after it, shape
            (2, signatures, features).
        owner: number of the fault of each signature in `classes`, shape (signatures,).
        sizes: size of each signature in the unit of its class, shape (signatures,).
        changing: share of a signature by which it differs from session to session, as a variance over its square.
        temperature: divisor of log-likelihoods that calibrates the probabilities on left-out sessions.
        strange: mean squared misfit of a direction, in its own variance, above which no fault explains an alarm.
        confusions: faults that cannot be told apart.
        provenance: machine, seed, sessions, time.
    """

    summaries: tuple[str, ...]
    classes: tuple[FaultClass, ...]
    scatter: Scatter
    signatures: Array
    owner: NDArray[np.int64]
    sizes: Array
    changing: float = 0.3
    temperature: float = 4.0
    strange: float = 10.0
    confusions: tuple[Confusion, ...] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)

    def rows_of(self, number: int) -> NDArray[np.int64]:
        """Return the signatures of a fault, the smallest size first."""
        rows = np.flatnonzero(self.owner == number)
        return rows[np.argsort(np.abs(self.sizes[rows] - self.classes[number].neutral), kind="stable")]


def signatures_of(
    classes: Sequence[FaultClass], owner: Sequence[int], sizes: Sequence[float], changes: Array
) -> tuple[Array, NDArray[np.int64], Array]:
    """Return the mean signatures of each fault and size.

    Args:
        classes: the faults.
        owner: number of the fault of each session.
        sizes: size of the fault in each session.
        changes: directions of each session less those of its sound twin, at the onset and after it, shape
            (sessions, 2, features).

    Returns:
        Signatures, owner and size of each.
    """
    keys = sorted(set(zip(owner, sizes, strict=True)))
    numbers_of_sessions, of_session = np.asarray(owner), np.asarray(sizes, dtype=np.float64)
    means = [changes[(numbers_of_sessions == number) & (of_session == size)].mean(axis=0) for number, size in keys]
    if {number for number, _ in keys} != set(range(len(classes))):
        raise DataError("a fault of the dictionary has no session; simulate all of one draw")
    return np.array(means).swapaxes(0, 1), np.array([k for k, _ in keys]), np.array([s for _, s in keys])


def save_dictionary(dictionary: Dictionary, folder: Path) -> None:
    """Write the dictionary into the folder of its monitor.

    Raises:
        StorageError: a file cannot be written.
    """
    scatter = dictionary.scatter
    arrays: dict[str, NDArray[Any]] = {
        "signatures": dictionary.signatures.astype(np.float32),
        "owner": dictionary.owner.astype(np.float32),
        "sizes": dictionary.sizes,
        "mean": scatter.mean,
        "lasting": scatter.lasting,
        "passing": scatter.passing,
        "matrix": scatter.matrix,
    }
    header = {
        "schema": SCHEMA,
        "summaries": list(dictionary.summaries),
        "classes": [fault.to_dict() for fault in dictionary.classes],
        "signatures": len(dictionary.owner),
        **{name: getattr(dictionary, name) for name in NUMBERS},
        "confusions": [asdict(pair) for pair in dictionary.confusions],
        "provenance": dict(dictionary.provenance),
    }
    write_stored(folder, FILE, header, arrays)


def remove_dictionary(folder: Path) -> None:
    """Remove the dictionary of an earlier monitor from a folder."""
    for suffix in (".json", ".safetensors"):
        (folder / f"{FILE}{suffix}").unlink(missing_ok=True)


def load_dictionary(folder: Path, summaries: Sequence[str]) -> Dictionary | None:
    """Read the dictionary of a monitor; None if missing.

    Args:
        folder: folder of the monitor.
        summaries: names of its summaries, which must be those of the dictionary.

    Raises:
        StorageError: damaged, changed, or of another monitor.
    """
    if not is_there(folder / f"{FILE}.json"):
        return None
    header, arrays = read_stored(folder, FILE, SCHEMA)
    where = f"'{folder / FILE}.json'"
    if header.get("summaries") != list(summaries):
        raise StorageError(f"{where} is of another monitor: its summaries differ; fit the monitor again")
    entries, count = header.get("classes"), header.get("signatures")
    if not isinstance(entries, list) or not 0 < len(entries) <= MAX_CLASSES or len(summaries) > MAX_SUMMARIES:
        raise StorageError(f"{where}: classes must be a list of 1 to {MAX_CLASSES}; fit the monitor again")
    if type(count) is not int or not 0 < count <= MAX_SIGNATURES:
        raise StorageError(f"{where}: signatures must be a number from 1 to {MAX_SIGNATURES}; fit the monitor again")
    try:
        classes = tuple(class_of(entry, where) for entry in entries)
        pairs = tuple(read_part(Confusion, entry, where) for entry in header.get("confusions", []))
        sizes = {"signatures": count, "features": 2 * len(summaries)}
        values = checked_arrays(arrays, ARRAYS, "the dictionary", sizes)
    except (DataError, TypeError, ValueError) as error:
        raise StorageError(f"{where} is damaged: {error}; fit the monitor again") from error
    lasting, passing = np.maximum(values["lasting"], 1e-12), np.maximum(values["passing"], 0.0)
    scatter, owner = Scatter(values["mean"], lasting, passing, values["matrix"]), values["owner"].astype(np.int64)
    if set(owner.tolist()) != set(range(len(classes))):
        raise StorageError(f"{where}: signatures are not those of its classes; fit the monitor again")
    numbers = {name: _positive(header.get(name), f"{where}: {name}") for name in NUMBERS}
    provenance = header.get("provenance")
    return Dictionary(
        tuple(summaries), classes, scatter, values["signatures"], owner, values["sizes"], **numbers, confusions=pairs,
        provenance=provenance if isinstance(provenance, dict) else {},
    )  # fmt: skip


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < 1e9:
        raise StorageError(f"{where} must be a number above 0; fit the monitor again")
    return float(value)
