"""From recordings to a defended feature set on disk: quality, screening, proposal, page, pictures, trials on wish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import tomli_w

from edp.config.experiment import Experiment, FeatureSettings, TaskSettings
from edp.data.feature_files import set_text
from edp.data.features import FEATURE_SETS, FeatureSet
from edp.data.screening import FlagKind, OnProgress, ScreeningResult, ScreeningSpec, screen
from edp.errors import DataError, closest, count_of
from edp.evaluation.trials_file import Trials
from edp.jobs import IN_PROCESS, Workers
from edp.logs import DataQuality, Repair, common_channels, open_log
from edp.logs.formats.base import is_truth
from edp.logs.resolve import resolve
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.recording import MAX_ROWS, Recording
from edp.report import build_screening_page, write_screening_pictures
from edp.signals import VOCABULARY, SignalMap
from edp.storage import check_writable, make_folder, write_bytes, write_json
from edp.storage.provenance import command_line
from edp.workflows.feature_selection.changes import add_changes
from edp.workflows.feature_selection.trials import OnTrial, TrialSpec, add_differences, try_feature_sets

PROPOSED, DIFFERENCES, CHANGES, ALL = "proposed", "proposed + differences", "proposed + changes", "all candidates"
# The file stays readable; the whole list is in `screening.json`.
_MAX_DROPPED = 200


@dataclass(frozen=True, kw_only=True)
class SelectionOrder:
    """Options of a feature selection.

    Attributes:
        spec: options of the screening.
        exclude: channels that are no candidates.
        truth: whether what only a simulation knows may be a candidate.
        pictures: whether pictures are written.
        experiment: settings of the trainings that try the sets; None for no trials.
        trials: random sets and seeds of the trials.
        sets: further feature sets to try, by name.
    """

    spec: ScreeningSpec = field(default_factory=ScreeningSpec)
    exclude: tuple[str, ...] = ()
    truth: bool = False
    pictures: bool = True
    experiment: Experiment | None = None
    trials: TrialSpec = field(default_factory=TrialSpec)
    sets: Mapping[str, str | FeatureSettings] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Listeners:
    """Who hears of the progress.

    Attributes:
        logs: progress of the inspection; its units are logs.
        on_progress: a stage of the screening, and the share of it all that is done.
        on_trial: a training: see `edp.workflows.feature_selection.trials`.
    """

    logs: Progress = SILENT
    on_progress: OnProgress | None = None
    on_trial: OnTrial | None = None


@dataclass(frozen=True, eq=False)
class Selection:
    """Findings and files of a feature selection.

    Attributes:
        screening: the screening.
        quality: quality of the recordings.
        notes: remarks on how the data were read.
        sets: the feature sets by name, the proposed one first.
        files: written files by type: ``page``, ``screening``, ``quality``, ``settings``, ``sets``, and optionally
            ``settings_with_changes``, ``map``, ``pictures``, ``trials``.
        trials: errors of the sets, where they were tried.
    """

    screening: ScreeningResult
    quality: DataQuality
    notes: tuple[str, ...]
    sets: dict[str, FeatureSettings]
    files: dict[str, Path]
    trials: Trials | None = None

    @property
    def map(self) -> Path | None:
        """The signal map that a training needs to read these channels, where it needs one."""
        return self.files.get("map")


def select_features(
    source: DataSource,
    out: str | Path,
    order: SelectionOrder | None = None,
    listeners: Listeners | None = None,
    workers: Workers = IN_PROCESS,
) -> Selection:
    """Screen a data set and write the proposed features.

    Args:
        source: source of the recordings. Without a signal map every numeric column is read.
        out: folder of all that is written.
        order: request of the user.
        listeners: who hears of the progress.
        workers: who inspects the recordings and trains the trials.

    Raises:
        EdpError: the recordings cannot be read as they are, or no conclusion can be drawn from them.
    """
    order, listeners = order or SelectionOrder(), listeners or Listeners()
    folder = check_writable(out)
    # Without a map all channels are read under the names of the files: a screening may judge each of them.
    mapped = source
    if source.signal_map is None and not source.stored and not _lists_maps(source):
        mapped = replace(source, signal_map=SignalMap(others=True))
    quality = mapped.inspect(listeners.logs, workers)
    recordings, notes = _read(mapped, quality)
    spec, more = _candidates(recordings[0], order)
    screening = screen(recordings, spec, listeners.on_progress)
    notes += [*more, *_note_sampling(recordings, screening)]
    sets = _sets(screening, recordings[0])
    files = _write(folder, screening, quality, sets)
    needed = _make_map(source, screening, recordings[0])
    if needed is not None:
        files["map"] = folder / "map.toml"
        write_bytes(files["map"], needed.encode())
    trials = _try_sets(mapped, folder, order, screening, sets, listeners.on_trial, workers)
    if trials is not None:
        files["trials"] = folder / "trials"
    if order.pictures:
        write_screening_pictures(screening, folder / "pictures")
        files["pictures"] = folder / "pictures"
    title = source.short_name
    files["page"] = build_screening_page(screening, title, quality, trials, notes).write(folder / "report.html")
    return Selection(screening, quality, tuple(notes), sets, files, trials)


def _note_sampling(recordings: Sequence[Recording], screening: ScreeningResult) -> list[str]:
    """Note that a large data set was screened on a part of its rows."""
    total = sum(recording.samples for recording in recordings)
    if total <= MAX_ROWS:
        return []
    hours = screening.samples / screening.rate_hz / 3600.0
    return [f"Screened on {screening.samples:,} of {total:,} rows ({hours:.1f} h): evenly spread stretches of them."]


def _lists_maps(source: DataSource) -> bool:
    """Test whether a data-set file names its own maps."""
    return source.path.suffix == ".toml" and any(log.signal_map is not None for log in source.logs())


def _read(source: DataSource, quality: DataQuality) -> tuple[list[Recording], list[str]]:
    """Return the recordings with their common channels; missing values of candidates stay missing."""
    repair = source.repair or Repair()
    # Missing values of one candidate must not refuse the whole log; the candidate is left out instead.
    lenient = replace(source, repair=replace(repair, nan="keep") if repair.nan == "refuse" else repair)
    recordings = common_channels((source if source.stored else lenient).read())
    common = set(recordings[0].channel_names)
    seen = {channel.name: None for report in quality.reports for channel in report.channels}
    lost = [name for name in seen if name not in common]
    notes = []
    if lost:
        notes.append(f"Only some recordings hold {_some(lost)}: left out.")
    holes = [
        name
        for name in recordings[0].channel_names
        if any(c.missing for report in quality.reports for c in report.channels if c.name == name)
    ]
    if holes and repair.nan == "refuse":
        notes.append(f"Missing values in {_some(holes)}: left out; a repair (nan=hold) would let them be judged.")
    return recordings, notes


def _candidates(first: Recording, order: SelectionOrder) -> tuple[ScreeningSpec, list[str]]:
    """Return the spec with its candidates named, and notes on excluded channels."""
    spec = order.spec
    for name in order.exclude:
        if name not in first.channel_names:
            raise DataError(f"cannot exclude '{name}': no such channel{closest(name, first.channel_names)}")
    chosen = [name for name in spec.candidates or first.channel_names if name not in order.exclude]
    notes = []
    if not order.truth and not spec.candidates:
        # Channels that no machine has would look best of all.
        hidden = [name for name in chosen if is_truth(name) and name not in spec.targets]
        chosen = [name for name in chosen if name not in hidden]
        if hidden:
            notes.append(
                f"{count_of(len(hidden), 'channel')} that only a simulation knows are no candidates (--truth takes "
                "them)."
            )
    return replace(spec, candidates=tuple(chosen)), notes


def _sets(screening: ScreeningResult, first: Recording) -> dict[str, FeatureSettings]:
    """Return the proposed set including targets, as the delta mode requires; the same with pressure changes.

    Standard sets.
    """
    names = screening.proposal.kept
    # Targets come first: delta mode reads their present values.
    channels = (*(target for target in screening.targets if target not in names), *names)
    proposed = FeatureSettings(name=PROPOSED, channels=channels)
    sets = {PROPOSED: proposed}
    differences = add_differences(proposed, first, DIFFERENCES)
    if differences.derived:
        sets[DIFFERENCES] = differences
    changes = add_changes(proposed, screening, first, CHANGES)
    if changes.derived:
        sets[CHANGES] = changes
    sets[ALL] = FeatureSettings(name=ALL, channels=screening.channels)
    for name, usual in FEATURE_SETS.items():
        if all(channel in first.channel_names for channel in usual.inputs):
            sets[name] = FeatureSettings(name=name, channels=usual.channels, derived=usual.derived, hidden=usual.hidden)
    return sets


def _write(
    folder: Path, screening: ScreeningResult, quality: DataQuality, sets: Mapping[str, FeatureSettings]
) -> dict[str, Path]:
    """Return everything but page and pictures."""
    files = {name: folder / f"{name}.json" for name in ("screening", "quality")}
    write_json(files["screening"], {"schema": 1, "command": command_line()} | screening.to_json())
    write_json(files["quality"], {"schema": 1} | quality.to_json())
    files["sets"] = make_folder(folder / "sets")
    for name, features in sets.items():
        text = _proposal_text(screening, features) if name == PROPOSED else set_text(_plain(features))
        write_bytes(files["sets"] / f"{_file_name(name)}.toml", text.encode())
    files["settings"] = folder / "settings.toml"
    write_bytes(files["settings"], _settings_text(screening, PROPOSED).encode())
    if CHANGES in sets:
        files["settings_with_changes"] = folder / "settings_with_changes.toml"
        write_bytes(files["settings_with_changes"], _settings_text(screening, CHANGES).encode())
    return files


def _plain(features: FeatureSettings) -> FeatureSet:
    return FeatureSet(features.name, features.channels, features.derived, features.hidden)


def _proposal_text(screening: ScreeningResult, features: FeatureSettings) -> str:
    """Return the proposed set with a reason for each channel, followed by the dropped channels with reasons."""
    reasons = {choice.channel: choice.reason for choice in screening.proposal.choices}
    for target in screening.targets:
        if target not in screening.proposal.kept:
            reasons[target] = "a target: its present value, which mode = 'delta' needs"
    head = [
        f"Proposed by edp data screen: {len(features.channels)} of "
        f"{count_of(len(screening.channels), 'channel')}, most "
        "useful first.",
        "edp train DATA --set task.features=THIS_FILE",
    ]
    dropped = [
        choice for choice in screening.proposal.choices if not choice.keep and choice.channel not in screening.targets
    ]
    tail = [f"dropped: {choice.channel}: {choice.reason}" for choice in dropped[:_MAX_DROPPED]]
    return set_text(_plain(features), head, reasons, tail)


def _settings_text(screening: ScreeningResult, name: str) -> str:
    """Return the settings of a training on a set, for use with a preset."""
    table = {
        "task": {
            "features": f"sets/{_file_name(name)}.toml",
            "targets": list(screening.targets),
            "horizons": [screening.horizon],
        },
        "model": {"window": screening.proposal.window},
    }
    why = " ".join(screening.proposal.window_reason.split())
    return f"# Settings for a training on what edp data screen proposed.\n# window: {why}\n\n{tomli_w.dumps(table)}"


def _make_map(source: DataSource, screening: ScreeningResult, first: Recording) -> str | None:
    """Return a signal map of the proposed channels if a training requires it."""
    if source.signal_map is not None or _lists_maps(source):
        return None
    names = tuple(dict.fromkeys((*screening.targets, *screening.proposal.kept)))
    resolved_names = []
    for log in source.logs():
        log_entries, problems = resolve(open_log(log.path, SignalMap()), SignalMap())
        # A log that cannot be resolved without a map shows that one is needed.
        resolved_names.append(() if problems else tuple(entry.channel.name for entry in log_entries))
    if all(set(names) <= set(own) and own == resolved_names[0] for own in resolved_names):
        return None
    entries: dict[str, object] = {}
    for name in names:
        kind = first.channels[first.index(name)].kind
        # The kind is stated where the name alone does not tell it.
        usual = VOCABULARY.get(name)
        entries[name] = {"column": name} | ({} if usual is not None and usual.kind == kind else {"kind": str(kind)})
    return "# The channels that edp data screen proposed, under the names of the files.\n\n" + tomli_w.dumps(
        {"channels": entries}
    )


def _try_sets(
    source: DataSource,
    folder: Path,
    order: SelectionOrder,
    screening: ScreeningResult,
    sets: Mapping[str, FeatureSettings],
    on_trial: OnTrial | None,
    workers: Workers,
) -> Trials | None:
    if order.experiment is None:
        return None
    experiment = replace(order.experiment, task=trial_task(order.experiment.task, screening))
    asked: dict[str, str | FeatureSettings] = {**sets, **order.sets}
    leaks = {flag.channel for flag in screening.flags if flag.kind is FlagKind.LEAK}
    barred = tuple(
        sorted(leaks | set(order.trials.excluded_channels))
    )  # a random set with a leak would look best of all
    return try_feature_sets(
        source, experiment, asked, folder / "trials", replace(order.trials, excluded_channels=barred), on_trial, workers
    )


def trial_task(task: TaskSettings, screening: ScreeningResult) -> TaskSettings:
    """Return the task of the trials: the screening's targets and horizon."""
    return replace(task, targets=screening.targets, horizons=(screening.horizon,))


def _some(names: Sequence[str], count: int = 6) -> str:
    return ", ".join(names) if len(names) <= count else f"{', '.join(names[:count])} and {len(names) - count} more"


def _file_name(name: str) -> str:
    return "_".join("".join(c if c.isalnum() else " " for c in name).split())
