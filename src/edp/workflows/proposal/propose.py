"""Propose a signal map and settings for unknown logs, and write them."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from edp.errors import ConfigError, StorageError, count_of
from edp.logs.proposal.experiments import Experiments, part_experiments
from edp.logs.proposal.frames import refuse_frames
from edp.logs.proposal.groups import LogGroup, group_logs
from edp.logs.proposal.propose import ColumnGuess, MapProposal, propose_map
from edp.logs.proposal.shapes import note_ignored_files, pace_notes, shape_notes
from edp.logs.proposal.timing import Timing, repair_table, timing_of
from edp.logs.read import find_recordings
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.signals import Kind
from edp.storage import make_folder, write_bytes
from edp.storage.folders import check_kind
from edp.storage.paths import full_path, is_file_at, is_link_at, is_there, status_of
from edp.workflows.proposal.choices import choose_split, choose_targets, propose_plant
from edp.workflows.proposal.files import (
    DATA,
    MAP,
    MAX_FEATURES,
    SETTINGS,
    check_files,
    data_set_text,
    map_table,
    name_paths,
    remarks_of,
    settings_text,
    toml_text,
)

_PAIR = re.compile(r"(.+?)[_ .]?(est|val|train|test|id|training|validation|identification)", re.IGNORECASE)
_TRAINS = ("est", "train", "id", "training", "identification")


@dataclass(frozen=True)
class LogsProposal:
    """Findings of `propose`.

    Attributes:
        source: the logs and folders that were asked about.
        group: the logs that belong together.
        others: further logs, with other columns.
        broken: logs that cannot be read, each with the reason.
        columns: the columns with what they are taken for.
        files: the texts to write, by name.
        targets: channels to predict.
        inputs: channels that command, where no kind tells it; `edp data check` sees their coverage only if they are
        named.
        repairs: repairs without which training would refuse the logs, in the notation of ``--repair``.
        notes: other remarks for the user.
        recordings: number of recordings that the commands read.
    """

    source: DataSource
    group: LogGroup
    others: tuple[LogGroup, ...]
    broken: dict[Path, str]
    proposal: MapProposal
    files: dict[str, str]
    targets: tuple[str, ...]
    inputs: tuple[str, ...]
    repairs: tuple[str, ...]
    notes: tuple[str, ...]
    recordings: int

    def commands(self, folder: Path) -> list[str]:
        """Return the next commands in order."""
        data, mapped, repair = self._logs(folder)
        run = _quoted(folder / "runs" / "first")
        inputs = f" --inputs {shlex.quote(','.join(self.inputs))}" if self.inputs else ""
        return [
            f"edp data check {data}{mapped}{inputs}",
            f"edp train {data}{mapped} --config {_quoted(folder / SETTINGS)} --out {run}{repair}",
            f"edp evaluate {run}",
            f"edp report {run}",
        ]

    def plant_command(self, folder: Path) -> str:
        """Return the command that trains a plant model on commands alone.

        Empty if `no_plant` gives a reason against it.
        """
        plant = propose_plant(self.proposal, self.targets, self.inputs)
        if plant.why_not:
            return ""
        named = "".join(
            f" --set {shlex.quote(f'channels.{part}={json.dumps(names, ensure_ascii=False)}')}"
            for part, names in plant.parts.items()
            if names
        )
        data, mapped, repair = self._logs(folder)
        # Of a single recording the end tests: there is no other one.
        split = " --set split.kind=time" if self.recordings == 1 else ""
        return f"edp twin {data}{mapped} --out {_quoted(folder / 'runs' / 'twin')}{repair}{named}{split}"

    def no_plant(self) -> str:
        """Return why no plant model is proposed, and what to record or to name, in a sentence; empty where one is."""
        return propose_plant(self.proposal, self.targets, self.inputs).why_not

    def _logs(self, folder: Path) -> tuple[str, str, str]:
        """Return logs, map and repairs as arguments of a command."""
        repair = "".join(f" --repair {one}" for one in self.repairs)
        if DATA in self.files:
            return _quoted(folder / DATA), "", repair
        return shlex.join(map(str, self.source.paths)), f" --map {_quoted(folder / MAP)}", repair


def _untold_inputs(proposal: MapProposal) -> tuple[str, ...]:
    """Return the command channels if all are generic; empty if a name contains the separator (comma)."""
    commands = proposal.select_role("command")
    names = tuple(guess.channel for guess in commands)
    plain = all(guess.kind.kind is Kind.GENERIC for guess in commands) and not any("," in name for name in names)
    return names if plain else ()


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def propose(path: str | Path | Sequence[str | Path], progress: Progress = SILENT) -> LogsProposal:
    """Examine logs and propose a map and settings, without writing files.

    Args:
        path: a log or a folder of logs, or several of them.
        progress: receiver of the progress; its units are logs.

    Raises:
        DataError: no log there can be read, or nothing in it can be predicted.
    """
    source = DataSource.from_path(path)
    for one in source.paths:
        if one.suffix.lower() == ".toml":
            raise ConfigError(f"'{one}' is a data-set file; give the log or the folder of logs that it is to describe")
    paths, copies = _drop_copies(list(dict.fromkeys(file for one in source.paths for file in find_recordings(one))))
    groups, broken = group_logs(paths, progress)
    experiments, others = part_experiments(groups[0]), tuple(groups[1:])
    group = groups[0] if experiments is None else experiments.group
    refuse_frames(group.looks[0])
    proposal = propose_map(group.looks[0], group.common, group.looks[1:])
    pairs = _side_by_side(proposal)
    if pairs:
        return _propose_from_pairs(source, group, others, broken, proposal, pairs)
    proposal, timing = _set_rate(group, proposal)
    notes = [*_notes(group, others, broken, proposal), *timing.notes]
    if copies:
        shown = ", ".join(f"{copy.name[:40]} (as {first.name[:40]})" for copy, first in copies[:3])
        rest = f" and {len(copies) - 3} more" if len(copies) > 3 else ""
        notes.append(f"left out, since they repeat another log byte for byte: {shown}{rest}")
    targets, more = choose_targets(proposal)
    chosen = {guess.column for guess in proposal.columns if guess.channel in targets}
    notes += [
        *more,
        *pace_notes(proposal.look, proposal.clock, chosen),
        *(note for one in source.paths for note in note_ignored_files(one, paths)),
    ]
    channels = [guess.channel for guess in proposal.select_role("reference", "command", "measured")]
    if len(channels) > MAX_FEATURES:
        notes.append(
            f"of {count_of(len(channels), 'moving channel')} the first {MAX_FEATURES} are features (task.features)"
        )
        channels = list(dict.fromkeys([*channels[:MAX_FEATURES], *targets]))
    split, why = choose_split(group, proposal, targets)
    if experiments is not None:
        tests = experiments.tests()
        split, why = ({"kind": "recordings", "test": tests}, []) if tests else (split, why)
        why = [*why, *_note_experiments(experiments, tests)]
    notes += why
    files = {
        MAP: toml_text(map_table(proposal.signal_map), remarks_of(source.paths, proposal)),
        SETTINGS: settings_text(proposal, channels, targets, split),
    }
    repairs, apart = timing.shared, timing.apart
    if experiments is not None or others or broken or apart or copies:
        listed = _recordings(group, proposal, experiments)
        recordings = [entry | ({"repair": repair_table(apart[one])} if one in apart else {}) for one, entry in listed]
        shared_map = MAP if experiments is None else None
        files[DATA] = data_set_text(recordings, shared_map, repair_table(repairs) if apart else {})
    if experiments is not None:
        del files[MAP]
    check_files(files)
    repairs = () if apart else repairs
    inputs = _untold_inputs(proposal)
    return LogsProposal(
        *(source, group, others, broken, proposal, files, targets, inputs, repairs, tuple(notes)),
        recordings=len(group.paths) if experiments is None else len(experiments.entries),
    )


def _recordings(
    group: LogGroup, proposal: MapProposal, experiments: Experiments | None
) -> list[tuple[Path, dict[str, object]]]:
    """Return the logs of a group as entries of a data set; an experiment has a map that names its variable."""
    if experiments is None:
        return [(path, {"path": str(full_path(path)), "name": name}) for path, name in name_paths(group.paths)]
    columns = map_table(proposal.signal_map)
    named = zip(group.paths, experiments.entries, experiments.names())
    return [
        (pseudo_path, {"path": str(full_path(path)), "name": name, "map": {"variable": variable} | columns})
        for pseudo_path, (path, variable), name in named
    ]


def _note_experiments(experiments: Experiments, tests: Sequence[str]) -> list[str]:
    """Return notes on parallel experiments."""
    parted = f", of which {len(tests)} test by their name" if tests else ""
    other = f"other columns: {', '.join(experiments.others[:3])}; give such logs on their own"
    return [
        f"{len(experiments.entries)} experiments stand beside each other: a recording each{parted}",
        *([other] if experiments.others else []),
    ]


def _drop_copies(paths: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, Path]]]:
    """Return the logs without copies, and each copy with the log that it repeats byte for byte.

    A test on a copy of what trained says nothing.
    """
    sizes = Counter(status_of(path).st_size for path in paths if is_file_at(path))
    seen: dict[bytes, Path] = {}
    single, copies = [], []
    for path in paths:
        if not is_file_at(path) or sizes[status_of(path).st_size] == 1:
            single.append(path)
            continue
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").digest()
        if digest in seen:
            copies.append((path, seen[digest]))
        else:
            seen[digest] = path
            single.append(path)
    return single, copies


def _set_rate(group: LogGroup, proposal: MapProposal) -> tuple[MapProposal, Timing]:
    """Return a proposal with one rate for logs with several rates, and the required repairs."""
    mapped = [guess.column for guess in proposal.columns if guess.channel]
    timing = timing_of(group.looks, proposal.clock, mapped)
    if timing.rate_hz is None:
        return proposal, timing
    clock = replace(proposal.clock, wanted_hz=timing.rate_hz)
    return replace(proposal, clock=clock, signal_map=replace(proposal.signal_map, rate_hz=timing.rate_hz)), timing


def write_proposal(proposal: LogsProposal, folder: str | Path, overwrite: bool = False) -> list[Path]:
    """Write the files of a proposal, each whole.

    Raises:
        StorageError: one is there already and may not be replaced, or cannot be written.
    """
    out = Path(folder)
    check_kind(out, what="edp init")
    paths = [out / name for name in proposal.files]
    there = [path for path in paths if is_there(path) or is_link_at(path)]
    if there and not overwrite:
        shown = ", ".join(f"'{path}'" for path in there)
        raise StorageError(
            f"{shown} exists already; nothing was written. Give another folder with --out, or --overwrite"
        )
    make_folder(out)
    for path, text in zip(paths, proposal.files.values()):
        write_bytes(path, text.encode())
    return paths


_FEW_ROWS = 700
"""Rows of all logs below which training refuses to divide them, or learns next to nothing."""


def _notes(group: LogGroup, others: Sequence[LogGroup], broken: dict[Path, str], proposal: MapProposal) -> list[str]:
    look, clock = proposal.look, proposal.clock
    notes = [] if not look.part else [f"{look.path.name}: looked at {look.part}"]
    notes += [f"{count_of(count, 'column')} {reason}: left out" for reason, count in look.left_out.items()]
    notes += shape_notes(look)
    notes += [f"time: {clock.check}"] if clock.check else []
    rows = sum(look.rows for look in group.looks) * len(group.paths) / len(group.looks)
    rate = clock.wanted_hz or clock.rate_hz
    rows *= rate / clock.rate_hz if rate and clock.rate_hz else 1.0
    if rows < _FEW_ROWS:
        notes.append(
            f"some {rows:,.0f} rows in all: too few to train and to test on; record more, or set rate_hz higher"
        )
    if len(group.looks) < len(group.paths):
        notes.append(
            f"{len(group.looks)} of {count_of(len(group.paths), 'log')} were looked at; of the others the columns only"
        )
    for other in others:
        names = ", ".join(path.name[:40] for path in other.paths[:3])
        notes.append(f"other columns: {names}{', ...' if len(other.paths) > 3 else ''}; give such logs on their own")
    roles = {guess.role for guess in proposal.columns}
    notes += ["labels: those that are known while the machine works may be features"] * ("label" in roles)
    notes += [f"not readable: {reason}" for reason in list(broken.values())[:3]]
    if len(broken) > 3:
        notes.append(f"{count_of(len(broken) - 3, 'more log')} cannot be read")
    return notes


def _side_by_side(proposal: MapProposal) -> dict[str, dict[str, ColumnGuess]]:
    """Return columns of two parallel experiments, ``uEst`` and ``uVal``, by ending and stem; empty without any."""
    sets: dict[str, dict[str, ColumnGuess]] = {}
    for guess in proposal.columns:
        if not guess.channel:
            continue
        match = _PAIR.fullmatch(guess.column)
        if match is None:
            return {}
        sets.setdefault(match[2].lower(), {})[match[1]] = guess
    stems = [sorted(entries) for entries in sets.values()]
    trains = [ending for ending in sets if ending in _TRAINS]
    return sets if len(sets) == 2 and len(trains) == 1 and stems[0] == stems[1] else {}


def _propose_from_pairs(
    source: DataSource,
    group: LogGroup,
    others: tuple[LogGroup, ...],
    broken: dict[Path, str],
    proposal: MapProposal,
    pairs: dict[str, dict[str, ColumnGuess]],
) -> LogsProposal:
    """Return two experiments in the columns of one log: a recording each."""
    train = next(ending for ending in pairs if ending in _TRAINS)
    test = next(ending for ending in pairs if ending != train)
    recordings = []
    for path, name in name_paths(group.paths):
        for ending in (train, test):
            renamed = [(stem, guess) for stem, guess in pairs[ending].items()]
            entries = tuple(
                replace(entry, name=stem)
                for stem, guess in renamed
                for entry in proposal.signal_map.channels
                if entry.column == guess.column
            )
            table = map_table(replace(proposal.signal_map, channels=entries))
            recordings.append({"path": str(full_path(path)), "name": f"{name}_{ending}", "map": table})
    renamed_columns = tuple(replace(guess, channel=stem) for stem, guess in pairs[train].items())
    renamed_proposal = replace(proposal, columns=renamed_columns)
    targets, notes = choose_targets(renamed_proposal)
    repairs = _set_rate(group, proposal)[1].shared
    channels = [guess.channel for guess in renamed_proposal.select_role("reference", "command", "measured")]
    tests = [str(one["name"]) for one in recordings if str(one["name"]).endswith(f"_{test}")]
    files = {
        DATA: data_set_text(recordings),
        SETTINGS: settings_text(proposal, channels, targets, {"kind": "recordings", "test": tests}),
    }
    check_files(files)
    notes += _notes(group, others, broken, proposal)
    notes.append(f"two experiments stand side by side: columns of '{train}' train, those of '{test}' test")
    inputs = _untold_inputs(renamed_proposal)
    return LogsProposal(
        *(source, group, others, broken, proposal, files, targets, inputs, repairs, tuple(notes)),
        recordings=len(recordings),
    )
