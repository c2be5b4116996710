"""MAT files: v4, v5 and v7.3; arrays, structs, Simulink logs, timeseries, Dataset, timetable and iddata objects."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, closest
from edp.logs.formats.base import (
    EXPERIMENTS,
    FORMATS,
    TRUTH,
    Column,
    RawLog,
    RawSignal,
    WriteOptions,
    find_time,
    parted,
    time_factor,
)
from edp.logs.formats.edp_metadata import EdpMetadata, facts_text, parse_edp_metadata
from edp.logs.formats.mat_layouts import LAYOUTS
from edp.logs.formats.matlab import INFO, MAGIC, MatVariables, is_v4
from edp.logs.units import normalise_unit
from edp.recording import Recording
from edp.signals import SignalMap

_MAX_NAMED = 100
"""Maximum number of experiment names compared with a misspelt name."""
_VERSIONS = {"v5": "v7", "v7.3": "v7.3"}
"""Name of each MAT version in the reading library. Its v7 is v5 with compressed variables."""


class MatFormat:
    """MATLAB's MAT file."""

    name = "mat"
    suffixes: tuple[str, ...] = (".mat",)
    content = "a MAT file"
    parts = True
    libraries = ("edp.logs.formats.matlab.unpacking",)

    def claims(self, head: bytes) -> bool:
        """Return whether the head is the text header of v5 or v7.3 (possibly cut off) or a v4 header."""
        if any(head.startswith(magic) or magic.startswith(head) for magic in MAGIC):
            return True
        return is_v4(head)

    def read(self, path: Path, signal_map: SignalMap) -> RawLog:
        """Read all variables, or the one that the map names."""
        from edp.logs.formats.matlab.unpacking import unpack  # pandas takes seconds to import

        mat_variables = unpack(path, signal_map.variable)
        edp_metadata = (
            EdpMetadata()
            if mat_variables.info is None
            else parse_edp_metadata(mat_variables.info, f"'{path}', variable '{INFO}'")
        )
        if signal_map.variable is not None:
            if signal_map.variable not in mat_variables.names:
                there = (*mat_variables.names, *mat_variables.experiment_names[:_MAX_NAMED])
                raise DataError(
                    f"'{path}' has no variable '{signal_map.variable}'{closest(signal_map.variable, there)}; "
                    "set 'variable' in the signal map to an existing one"
                )
            if signal_map.variable == TRUTH and edp_metadata.truth:
                edp_metadata = replace(edp_metadata, channels=edp_metadata.truth, digest=edp_metadata.truth_digest)
        if mat_variables.experiments > 1:
            first = mat_variables.experiment_names[0] if mat_variables.experiment_names else "data{1}"
            raise DataError(
                f"'{path}' holds {mat_variables.experiments} experiments in one iddata, which are no single log; read "
                f'each as a recording of its own: variable = "{first}" in its map (edp init writes a data set of '
                "them), or save it to a file (in MATLAB: one = getexp(data, 1); save('one.mat', 'one'))"
            )
        if not mat_variables.signals:
            raise DataError(
                f"'{path}' holds no signals (variables: {', '.join(mat_variables.names[:12]) or 'none'}); expected "
                "numeric vectors, structs of them, timeseries, a Dataset, a timetable or iddata"
            )
        return _raw_log(path, mat_variables, edp_metadata, signal_map)

    def write(self, recording: Recording, path: Path, options: WriteOptions) -> None:
        """Write the variables in the requested layout, and ``edp_info``, a JSON text with units and metadata."""
        if options.mat_version not in _VERSIONS:
            closest_version = closest(options.mat_version, _VERSIONS)
            raise DataError(f"MAT version '{options.mat_version}' cannot be written{closest_version}")
        # 63 is MATLAB's namelengthmax.
        long = [name for name in recording.channel_names if not name.isidentifier() or len(name) > 63]
        if long:
            raise DataError(
                f"channel(s) {', '.join(long)} cannot be MATLAB names (letters, digits, underscore, at most 63); "
                "rename them in the signal map"
            )
        from edp.logs.formats.matlab.library import matio

        layout = LAYOUTS[options.mat_layout]
        measured, truth = parted(recording) if options.truth == "apart" else (recording, None)
        variables = layout.variables(measured or recording)
        if truth is not None:
            variables[TRUTH] = layout.build(truth)
        variables[INFO] = facts_text(measured or recording, truth)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                matio.save_to_mat(
                    str(path),
                    variables,
                    version=_VERSIONS[options.mat_version],
                    saveobj_classes=list(layout.saveobj_classes) or None,
                )
                if options.mat_version == "v7.3":
                    # mat-io leaves the text of a v5 header there; MATLAB goes by the version number behind it.
                    with path.open("rb+") as stream:
                        stream.write(MAGIC[1])
            except RuntimeError as error:
                # h5py reports a failed write (disk full) as RuntimeError.
                raise OSError(str(error)) from error


FORMATS.register("mat")(MatFormat())


class _Table:
    """Columns in memory."""

    def __init__(self, columns: Mapping[str, NDArray[Any]]) -> None:
        self.columns = columns

    def pieces(self, names: Sequence[str], start: int, stop: int) -> Iterator[list[NDArray[Any]]]:
        """See `edp.logs.formats.base.ColumnTable`."""
        yield [self.columns[name][start:stop] for name in names]


def _raw_log(path: Path, mat_variables: MatVariables, edp_metadata: EdpMetadata, signal_map: SignalMap) -> RawLog:
    names = [part.name for part in mat_variables.signals]
    timeless = [part.name for part in mat_variables.signals if part.time is None]
    # EDP's files state their rate: a channel called t would be taken for time.
    time_name = None if edp_metadata.rate_hz else find_time(timeless, signal_map, path)
    time: Column | None = None
    if time_name is not None:
        part = mat_variables.signals[names.index(time_name)]
        time = np.asarray(part.values, dtype=np.float64) * time_factor(time_name, None, signal_map)
    signals: dict[str, RawSignal] = {}
    table = _Table({part.name: part.values for part in mat_variables.signals})
    for part in mat_variables.signals:
        if part.name == time_name:
            continue
        channel = edp_metadata.channels.get(part.name)
        own_time = part.time if signal_map.sample_time_s is None else None
        if own_time is None and time is not None and len(time) == len(part.values):
            own_time = time
        signals[part.name] = RawSignal(
            part.name,
            partial(np.asarray, part.values, dtype=np.float64),
            len(part.values),
            own_time,
            unit=normalise_unit(part.unit) or (channel.unit if channel else None),
            kind=channel.kind if channel else None,
            description=channel.description if channel else "",
            table=table,
            key=part.name,
        )
    if edp_metadata.channels:
        signals = {name: signals[name] for name in edp_metadata.channels if name in signals}
    repeated = {
        name: full for name, full in mat_variables.repeated.items() if name != time_name and set(full) <= set(signals)
    }
    facts = edp_metadata.to_log_metadata()
    if mat_variables.experiment_names:
        facts["meta"] = {**facts.get("meta", {}), EXPERIMENTS: mat_variables.experiment_names}
    return RawLog(path, signals, mat_variables.scalars, repeated=repeated, **facts)
