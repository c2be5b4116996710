"""What the command lines of docs/ take for given: files and folders by their names on the pages, small.

A line runs as it stands in a folder of its own, shortened by `SHORTER` and `MORE`. What it reads lies there under the
name that it uses; which thing that is follows from the command and the place of the word in it (`ROLES`), or from the
name where that tells more (`NAMES`, `SPECIAL`). Things are made once, mostly by commands themselves, and copied.
"""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
from page_grounds import lever_logs
from small_monitors import fitted_monitor
from small_studies import CHANGES

from edp.cli import app
from edp.cli.console import run_app
from edp.cli.groups import RUN, RunByDefault
from edp.cli.names import FOCUS, SIMULATION
from edp.logs import write_recording
from edp.monitor.monitor_file import save_monitor
from edp.networks.twin import TWINS
from edp.networks.twin.grey.ground_contact import NUMBERS
from edp.networks.twin.grey.ground_drag import DragLaw
from edp.recording import Recording
from edp.signals import TABLE_A1, VOCABULARY, Channel, Kind
from edp.testing.control import sample_excavator_twin, sample_grey_box
from edp.testing.monitor import rig_sessions
from edp.testing.twins import sample_actuators
from edp.training.twin_bundle import TwinBundle, save_twin
from edp_site import commands

ROOT = Path(__file__).parents[2]
TRAINING = (
    "training.epochs=1",
    "training.updates=3",
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[6],kernel=3,units=6}',
    "model.head.hidden=6",
    "model.window=12",
    "evaluation.history=5",
)
MACHINES = (
    'split.kind="machines"',
    'task={features={name="lever",channels=["speed","lever"]},targets=["speed"],horizons=[2]}',
    "model.blocks=[]",
    *TRAINING,
)
FEW = ('task.targets=["CylVels_1"]', 'task.features={name="few",channels=["CylVels_1","BmUp"]}')
LIMIT = ("limit.moments=4", "limit.branches=4", "limit.horizons=[1,10]")
TUNING = ("--trials", "2", "--tuning-loops", "1", "--evaluation-loops", "1")
LOOP = ("task.length_m=[0.4,0.5]", "task.hold_s=0.2", "task.lead_s=0.2")
JUDGED = ("evaluation.duration_s=4", "evaluation.starts=2", "evaluation.at_s=[1,4]")
TWIN = ("twin.kind=arx", *JUDGED)
RECURRENT = (
    *("twin.kind=recurrent", "twin.units=6", "twin.prefix_ticks=20", "training.batch=4", "training.lengths_s=[0.2]"),
    *("training.updates=[2]", "training.validate_every=2", *JUDGED),
)


def settings(changes: tuple[str, ...]) -> list[str]:
    """Changes as options."""
    return [word for change in changes for word in ("--set", change)]


def edp(*words: object) -> int:
    """A command in this process; its exit code."""
    with mock.patch.object(sys, "argv", ["edp", *map(str, words)]):
        return run_app(app)


class Line(NamedTuple):
    """A command line of a page.

    Attributes:
        page: file name.
        number: of the line on the page.
        text: as it stands, without a remark.
        command: its words, such as ``monitor fit``.
        words: what follows them.
    """

    page: str
    number: int
    text: str
    command: str
    words: tuple[str, ...]

    @property
    def ends_within_an_option(self) -> bool:
        """Whether the value of the last option is missing: a sentence names the option."""
        last = commands.commands()[tuple(self.command.split())].options.get(self.words[-1])
        return last is not None and not getattr(last, "is_flag", False)

    @property
    def roles(self) -> tuple[str, ...]:
        """Of each word: an option's name for its value, an empty text for an option, else its place, ``0`` first."""
        options = commands.commands()[tuple(self.command.split())].options
        named, place, after = [], 0, ""
        for word in self.words:
            if after:
                named.append(after)
                after = ""
            elif word.startswith("-") and word in options:
                named.append("")
                after = "" if getattr(options[word], "is_flag", False) else word
            else:
                named.append(str(place))
                place += 1
        return tuple(named)


def lines_of(page: Path) -> Iterator[Line]:
    """Lines of a page that can be run: they give all that the command cannot do without, and something at all.

    Others, mostly in sentences, name a command or an option.
    """
    known = commands.commands()
    for number, text in commands.command_lines(page.read_text(encoding="utf-8")):
        words = shlex.split(text, comments=True)[1:]
        named: tuple[str, ...] = ()
        while words and (*named, words[0]) in known:
            named = (*named, words.pop(0))
        if words and isinstance(known[named].parsed, RunByDefault):
            named = (*named, RUN)
        if named == ("train", RUN) and (FOCUS, SIMULATION) in pairwise(words):
            # The command line reads it as its short form.
            place = words.index(FOCUS)
            named, words = ("twin",), [*words[:place], *words[place + 2 :]]
        if not words or words[-1] == "--help" or "..." in words or hasattr(known[named].parsed, "commands"):
            continue
        if any(word.endswith("...") for word in words):
            continue
        words = [word.strip("[]") if word.isupper() else word for word in words]
        line = Line(page.name, number, " ".join(shlex.split(text, comments=True)), " ".join(named), tuple(words))
        places = [option for option in known[named].parsed.params if not option.opts[0].startswith("-")]
        needed = sum(option.required for option in places)
        must = [option for option in known[named].parsed.params if option.required and option not in places]
        given = sum(role.isdigit() for role in line.roles)
        whole = given >= needed and all(set(option.opts) & set(line.words) for option in must)
        if whole and not line.ends_within_an_option:
            yield line


class Ground:
    """Things by kind, each made once.

    Args:
        folder: that holds them.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._made: set[str] = set()

    def of(self, kind: str) -> Path:
        """The thing of a kind; its maker is called at the first time."""
        path = self.folder / kind
        if kind not in self._made:
            path.parent.mkdir(parents=True, exist_ok=True)
            with chdir(self.folder):
                MAKERS[kind](self, path)
            self._made.add(kind)
        return path

    def lay(self, line: Line, folder: Path) -> list[str]:
        """Put what a line reads under the names that it has there; the words of the line, shortened."""
        (folder / "examples").symlink_to(ROOT / "examples")
        for pattern, name, kind in BESIDE:
            if re.search(pattern, line.text):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                source = self.of(kind)
                (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / name)
        words = []
        for role, word in zip(line.roles, line.words):
            kind = kind_of(line, role, word)
            path = folder / word.partition("#")[0]
            if kind and not path.exists() and ".." not in word:
                path.parent.mkdir(parents=True, exist_ok=True)
                source = self.of(kind)
                if source.is_dir() and path.suffix in (".parquet", ".csv"):
                    source = min(source.glob(f"*{path.suffix}"))
                (shutil.copytree if source.is_dir() else shutil.copy)(source, path)
            words.append(SHORTER.get((line.command, role), SHORTER.get(("", role), word)))
        return [*words, *more_of(line)]


def kind_of(line: Line, role: str, word: str) -> str:
    """What a word of a line stands for; empty where the command writes it, or it is no file."""
    if not role or role in WRITTEN or (line.command, role) in POSITIONS_WRITTEN:
        return ""
    for pattern, name, kind in SPECIAL:
        if re.search(pattern, line.text) and word == name:
            return kind
    if word.startswith("examples/"):
        return ""
    last = str(sum(other.isdigit() for other in line.roles) - 1)
    kind = ROLES.get((line.command, role), ROLES.get(("", role), ""))
    if (line.command, "last") in ROLES and role == last:
        kind = ROLES[line.command, "last"]
    kind = MAPPED.get(kind, kind) if "--map" in line.words else kind
    if kind == "map" and line.command == "twin":
        kind = "actuators_map"
    named = next((kind for pattern, kind in NAMES.items() if re.fullmatch(pattern, word)), "")
    return named if kind and named else kind


def more_of(line: Line) -> list[str]:
    """Options that make a line short."""
    key = next((key for key in MORE if re.search(key, f"{line.command} {line.text}")), "")
    return list(MORE.get(key, ()))


def _logs() -> list[Recording]:
    """The 24 logged channels: slow velocities that follow slow levers, pressures beside them."""
    recordings = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        waves = np.sin(2 * np.pi * rng.uniform(0.1, 0.6, 24) * np.arange(600)[:, None] / 100.0 + rng.uniform(0, 6, 24))
        size = np.array([{"m/s": 0.2, "m/s^2": 1.0}.get(channel.unit, 2e6) for channel in TABLE_A1.values()])
        values = np.where(size > 1e5, 3e6, 0.0) + size * (waves + 0.02 * rng.normal(size=waves.shape))
        recordings.append(
            Recording(f"drive_{seed}", tuple(TABLE_A1.values()), values.astype(np.float32), 100.0, source="test")
        )
    return recordings


def _write(recordings: list[Recording], folder: Path) -> None:
    folder.mkdir(parents=True)
    for recording in recordings:
        write_recording(recording, folder / f"{recording.name}.parquet")


def _table(logs: Path, path: Path) -> None:
    """The same logs as CSV files with columns of somebody else; the map of `_map_of` goes with them."""
    from edp.logs import read_data_set

    path.mkdir(parents=True)
    for recording in read_data_set(logs):
        rows = np.column_stack([np.arange(recording.samples) / recording.rate_hz, recording.values])
        names = ",".join(["t", *(f"col_{n}" for n in range(len(recording.channels)))])
        np.savetxt(path / f"{recording.name}.csv", rows, delimiter=",", header=names, comments="", fmt="%.9g")


def _map_of(logs: Path, path: Path) -> None:
    from edp.logs import read_data_set

    text = 'time = "t"\ntime_unit = "s"\n'
    for number, channel in enumerate(read_data_set(logs)[0].channels):
        text += (
            f'[channels.{channel.name}]\ncolumn = "col_{number}"\nkind = "{channel.kind}"\nunit = "{channel.unit}"\n'
        )
    path.write_text(text, encoding="utf-8")


def _lever_rig(ground: Ground, path: Path) -> None:
    with chdir(ground.folder):
        lever_logs(path)
    text = (ground.folder / "map.toml").read_text(encoding="utf-8").replace("[channels.speed]", "[channels.velocity]")
    (ground.folder / "lever_map").write_text(text, encoding="utf-8")


def _lever_map(ground: Ground, path: Path) -> None:
    ground.of("lever_rig")


def _rig(ground: Ground, path: Path) -> None:
    names = ("BmUp", "CylVels_1", "CylStroke_1", "CylPressures_1", "CylPressures_5")
    channels = tuple(VOCABULARY[name] for name in names)
    _write([replace(session, channels=channels) for session in rig_sessions(18, 2000, seed=4)], path)


def _drives(ground: Ground, path: Path) -> None:
    """Speeds that follow levers with a gain of the machine's own; two logs of each of six machines."""
    channels = (Channel("lever", Kind.PILOT_PRESSURE), Channel("speed", Kind.VELOCITY))
    recordings = []
    for machine in range(6):
        for seed in range(2):
            lever = 1e6 * np.repeat(np.random.default_rng(100 * machine + seed).uniform(0, 3, 46), 20)[:900]
            speed = np.zeros(900)
            for t in range(3, 900):
                speed[t] = 0.9 * speed[t - 1] + 0.1 * (0.1 + 0.05 * machine) * (lever[t - 3] / 1e6 - 1.5)
            values = np.column_stack([lever, speed]).astype(np.float32)
            meta = {"machine": "digger 7" if machine == 3 else f"press {machine}", "mass_t": 10.0 + machine}
            recordings.append(Recording(f"m{machine}_{seed}", channels, values, 100.0, source="test", meta=meta))
    _write(recordings, path)


def _named(ground: Ground, path: Path) -> None:
    """Two velocities under names of somebody's own, each behind a lever."""
    recordings = []
    for seed in range(6):
        lever = np.repeat(np.random.default_rng(seed).uniform(-1, 1, (60, 2)), 20, axis=0)
        speed = np.stack([np.convolve(one, 0.01 * 0.9 ** np.arange(60))[:1200] for one in lever.T], axis=1)
        channels = [Channel(f"lever_{n}", Kind.GENERIC) for n in (1, 2)]
        channels += [Channel(name, Kind.VELOCITY) for name in ("v_boom", "v_arm")]
        values = np.concatenate([lever, speed], axis=1).astype(np.float32)
        recordings.append(Recording(f"n{seed}", tuple(channels), values, 100.0, source="test"))
    _write(recordings, path)


def _grounded(ground: Ground, path: Path) -> None:
    """A grey box on a ground without resistance, neither of them fitted."""
    law = DragLaw(np.zeros(NUMBERS), np.zeros(NUMBERS), bucket_m=1.3, surface_m=-1.5)
    save_twin(replace(sample_grey_box("C14"), ground=law), path / "twin")


def _monitor(ground: Ground, path: Path) -> None:
    from edp.logs import read_data_set

    save_monitor(fitted_monitor(list(read_data_set(ground.of("rig")))[:12]), path)


def _made_by(*words: str, codes: tuple[int, ...] = (0,)) -> Callable[[Ground, Path], None]:
    """A maker that is a command: ``{out}`` is the thing, ``{logs}`` and the like are others."""

    def make(ground: Ground, path: Path) -> None:
        filled = [
            re.sub(r"^\{(\w+)\}", lambda m: str(path if m[1] == "out" else ground.of(m[1])), word) for word in words
        ]
        code = edp(*filled)
        assert code in codes, f"edp {shlex.join(filled)}: {code}"

    return make


def _fmu(ground: Ground, path: Path, version: str) -> None:
    made = ground.folder / "units"
    if not made.is_dir():
        assert edp("export", ground.of("front_twin"), "--format", "fmu", "--out", made, "--name", "twin") == 0
    shutil.copy(made / f"twin_fmi{version}.fmu", path)


def _tuned(ground: Ground, path: Path) -> None:
    made = ground.folder / "tuning"
    words = ("--tuning-plant", ground.of("front_twin"), *TUNING, *settings(LOOP))
    assert edp("loop", "tune", made, "--controller", "pi", *words) == 0
    shutil.copy(made / "tuned.toml", path)


def _judged(ground: Ground, path: Path) -> None:
    _made_by("train", "{logs}", "--out", "{out}", "--preset", "quick", *settings(TRAINING))(ground, path)
    assert edp("evaluate", path, "--baselines", "persistence") in (0, 6)


def _machine(ground: Ground, path: Path) -> None:
    """A machine of one's own, as docs/explanation/simulator.md has it: a copy of one that comes with EDP."""
    text = resources.files("edp.sim.machines").joinpath("m22.toml").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")


def _all_but_one(folder: str, names: list[str]) -> list[str]:
    logs = sorted(name for name in names if name.endswith(".parquet"))
    return [name for name in names if name not in logs[:1]]


def _screened(ground: Ground, path: Path) -> None:
    path.write_text('[task]\nhorizons = [10]\n[task.features]\nname = "mine"\nchannels = ["CylVels_1", "BmUp"]\n')


MAKERS: Mapping[str, Callable[[Ground, Path], None]] = {
    "logs": lambda ground, path: _write(_logs(), path),
    "rig_csv": lambda ground, path: _table(ground.of("rig"), path),
    "rig_map": lambda ground, path: _map_of(ground.of("rig"), path),
    "actuators_csv": lambda ground, path: _table(ground.of("actuators"), path),
    "actuators_map": lambda ground, path: _map_of(ground.of("actuators"), path),
    "study": _made_by(
        "search", "{logs}", "--out", "{out}", "--workers", "1", "--phase", "calibration", *settings(CHANGES)
    ),
    "mapped": lambda ground, path: _table(ground.of("logs"), path),
    "map": lambda ground, path: _map_of(ground.of("logs"), path),
    "settings": _screened,
    "lever_rig": _lever_rig,
    "lever_map": _lever_map,
    "rig": _rig,
    "drives": _drives,
    "named": _named,
    "actuators": lambda ground, path: _write([sample_actuators(seed=seed) for seed in range(6)], path),
    "machine": _machine,
    "budget": lambda ground, path: shutil.copy(ROOT / "examples" / "budgets" / "small_controller.toml", path),
    "front": _made_by("simulate", "{out}", "--duration", "24s", "--recordings", "4", "--workers", "1"),
    "front_log": lambda ground, path: shutil.copytree(ground.of("front"), path, ignore=_all_but_one),
    "one_log": lambda ground, path: shutil.copytree(ground.of("logs"), path, ignore=_all_but_one),
    "rig_log": lambda ground, path: shutil.copytree(ground.of("rig"), path, ignore=_all_but_one),
    "actuator_log": lambda ground, path: shutil.copytree(ground.of("actuators"), path, ignore=_all_but_one),
    "actuator_run": _made_by(
        *("train", "{actuators}", "--out", "{out}", "--preset", "quick"),
        *settings(('task={features="all",targets=["speed_1","speed_2"],horizons=[10]}', "model.blocks=[]", *TRAINING)),
    ),
    "ahead": _made_by(
        "train", "{logs}", "--out", "{out}", "--preset", "quick", *settings(("task.horizons=[20]", *TRAINING))
    ),
    "run": _judged,
    "adapted": _made_by("adapt", "{run}", "--out", "{out}"),
    "whole": _made_by("compress", "quantise", "{run}", "--out", "{out}"),
    "twin": _made_by("twin", "{actuators}", "--out", "{out}", *settings(TWIN), codes=(0, 6)),
    "recurrent": _made_by("twin", "{actuators}", "--out", "{out}", *settings(RECURRENT), codes=(0, 6)),
    "rig_run": _made_by(
        *("train", "{rig}", "--out", "{out}", "--preset", "quick"),
        *settings(('task={features="all",targets=["CylVels_1"],horizons=[10]}', "model.blocks=[]", *TRAINING)),
    ),
    "front_twin": lambda ground, path: save_twin(TwinBundle(TWINS["static"](), sample_excavator_twin()), path / "twin"),
    "grounded": _grounded,
    "fmi2": lambda ground, path: _fmu(ground, path, "2"),
    "fmi3": lambda ground, path: _fmu(ground, path, "3"),
    "loop": _made_by("loop", "run", "{out}", "--plant", "{front_twin}", "--loops", "1", *settings(LOOP)),
    "tuned": _tuned,
    "monitor": _monitor,
    "watched": _made_by("monitor", "run", "{monitor}", "{rig}", "--out", "{out}", codes=(0, 5)),
    "store": _made_by("data", "store", "build", "{logs}", "--out", "{out}", "--workers", "1"),
    "fleet": _made_by("data", "store", "build", "{drives}", "--out", "{out}", "--workers", "1"),
    "base": _made_by("train", "pretrain", "{drives}", "--out", "{out}", "--preset", "quick", *settings(MACHINES)),
    "registry": _made_by("registry", "add", "{out}", "{base}", "--name", "base"),
    "deltas": _made_by("train", "finetune", "{base}", "--fleet", "{fleet}", "--out", "{out}", "--workers", "1"),
}
"""By kind."""
WRITTEN = {"--out", "--page", "--save", "--record", "--mdf", "--name", "--format", "--set"}
POSITIONS_WRITTEN = {("simulate", "0"), ("loop run", "0"), ("loop tune", "0"), ("registry add", "0")}
ROLES: Mapping[tuple[str, str], str] = {
    **{
        (name, "0"): "logs"
        for name in ("train run", "data check", "init", "data screen", "search run", "data store build")
    },
    **{
        (name, "0"): "run"
        for name in ("evaluate", "report", "verify", "export", "adapt run", "compare", "train finetune", "live")
    },
    **{
        (name, "0"): "run"
        for name in ("data animate", *(f"compress {name}" for name in ("estimate", "distil", "search", "quantise")))
    },
    **{("compare", str(place)): "run" for place in range(3)},
    ("twin", "0"): "actuators",
    ("train pretrain", "0"): "drives",
    ("twin", "--start"): "recurrent",
    ("rollout", "0"): "twin",
    ("rollout", "1"): "actuator_log",
    ("data add-forecasts", "0"): "twin",
    ("data add-forecasts", "1"): "actuators",
    ("calibrate", "0"): "front",
    ("adapt replay", "0"): "adapted",
    ("adapt replay", "1"): "logs",
    ("train finetune", "1"): "logs",
    ("data animate", "last"): "front_log",
    ("monitor fit", "0"): "rig_run",
    ("monitor fit", "last"): "rig",
    ("monitor run", "0"): "monitor",
    ("monitor run", "1"): "rig",
    ("monitor report", "0"): "watched",
    ("fleet report", "0"): "base",
    ("fleet report", "1"): "fleet",
    ("fleet report", "--deltas"): "deltas",
    ("fleet network", "0"): "deltas",
    ("train finetune", "--fleet"): "fleet",
    ("registry add", "1"): "run",
    ("registry list", "0"): "registry",
    ("registry show", "0"): "registry",
    ("data store verify", "0"): "store",
    **{(f"search {name}", "0"): "study" for name in ("status", "report", "export")},
    ("simulate", "--machine"): "machine",
    ("train run", "--start"): "base",
    ("runs", "0"): "run",
    ("loop run", "--plant"): "front_twin",
    ("loop run", "--twin"): "front_twin",
    ("loop run", "--predictor"): "ahead",
    ("loop run", "--config"): "tuned",
    ("loop tune", "--tuning-plant"): "front_twin",
    ("", "--budget"): "budget",
    ("", "--monitor"): "monitor",
    ("", "--map"): "map",
    ("", "--config"): "settings",
    ("", "--data"): "logs",
    ("", "--log"): "one_log",
    ("evaluate", "--predictor"): "actuator_run",
}
"""Kind by command and place or option; without a command, of every one."""
NAMES: Mapping[str, str] = {
    r"store": "store",
    r".*_w8a16": "whole",
    r".*_adapted": "adapted",
    r"runs/twin|TWIN": "twin",
    r"MONITOR|monitors/.*": "monitor",
    r".*_fmi2\.fmu": "fmi2",
    r".*_fmi3\.fmu": "fmi3",
}
"""Kind by what a word looks like, where its place alone does not tell."""
MAPPED = {"logs": "mapped", "actuators": "actuators_csv"}
"""Kinds of logs that a map goes with."""
SPECIAL: tuple[tuple[str, str, str], ...] = (
    (r"velocity", "logs/", "lever_rig"),
    (r"velocity", "map.toml", "lever_map"),
    (r"v_boom", "logs/", "named"),
    (r"auto.foundation", "logs/mine", "drives"),
    (r"finetune runs/foundation", "runs/foundation", "base"),
    (r"finetune runs/foundation", "logs/mine", "drives"),
    (r"fleet/store", "fleet/store", "fleet"),
    (r"finetune fleet/base", "fleet/base", "base"),
    (r"finetune RUN --fleet", "RUN", "base"),
    (r"fleet report", "RUN", "base"),
    (r"format controller", "RUN", "loop"),
    (r"runs/plan --format controller", "runs/plan", "loop"),
    (r"runs/tuned_loop --format controller", "runs/tuned_loop", "loop"),
    (r"loop (run|tune) .*runs/twin", "runs/twin", "front_twin"),
    (r"runs/twin --data", "logs/monday", "actuators"),
    (r"loop run .*--machine mine.toml", "mine.toml", "machine"),
    (r"linkage=mine", "logs", "front"),
    (r"logs/healthy --map", "logs/healthy", "rig_csv"),
    (r"(logs/healthy|logs/today) --map", "map.toml", "rig_map"),
    (r"logs/today --map", "logs/today", "rig_csv"),
    (r"registry add .* fleet/base", "fleet/base", "base"),
    (r"runs/grey_loam --set task", "runs/grey_loam", "grounded"),
    (r"(twin|simulation) .*--start runs/twin", "runs/twin", "recurrent"),
    (r"auto.foundation", "logs/c14", "drives"),
    (r"live .*--monitor", "runs/m22", "rig_run"),
    (r"live .*--monitor", "data/m22/m22_000_combined.parquet", "rig_log"),
)
"""Line, word and kind: what neither place nor name tells."""
BESIDE = (
    (r"twin.linkage=mine.toml", "mine.toml", "machine"),
    (r"auto.foundation=runs/foundation", "runs/foundation", "base"),
)
"""Line, name and kind of what a setting names."""
SHORTER: Mapping[tuple[str, str], str] = {
    ("simulate", "--duration"): "6s",
    ("", "--time-budget"): "1.2s",
    ("", "--recordings"): "2",
    ("", "--workers"): "1",
    ("", "--loops"): "1",
    ("", "--tuning-loops"): "1",
    ("", "--evaluation-loops"): "1",
    ("rollout", "--from"): "1",
    ("rollout", "--rollout-seconds"): "2",
    ("monitor fit", "--hours-per-false-alarm"): "0.04",
    ("", "--units"): "4",
    ("fleet network", "1"): "digger 7",
}
"""Values of options that a test cannot wait for, by command and option."""
MORE: Mapping[str, tuple[str, ...]] = {
    r"^train run .*--preset (quick|small)": tuple(settings(TRAINING)),
    r"^init (?!.*--yes)": ("--yes",),
    r"^train run .*foundation": ("--time-budget", "0.6s", *settings(MACHINES[1:2])),
    r"^train run .*velocity": ("--time-budget", "0.6s"),
    r"^train run .*features=all": ("--time-budget", "0.6s", *settings(FEW[:1])),
    r"^train run .*--time-budget": tuple(settings(FEW)),
    r"^train run .*--config examples": (),
    r"^train run": ("--time-budget", "0.6s", *settings(FEW)),
    r"^search run .*--preset thesis": (
        *("--phase", "isolation", "--workers", "1"),
        *settings((*CHANGES, "search.epochs=2")),
    ),
    r"^search run": ("--phase", "isolation", "--workers", "1", *settings(CHANGES)),
    r"^train pretrain .*test_masses": ("--preset", "quick", *settings(MACHINES[1:])),
    r"^train pretrain (?!.*--preset)": ("--preset", "quick", *settings(MACHINES)),
    r"^train pretrain": tuple(settings(MACHINES)),
    r"^monitor fit .*--hours": ("--time-budget", "1.2s"),
    r"^monitor fit": ("--time-budget", "1.2s", "--hours-per-false-alarm", "0.04"),
    r"^twin .*--start": tuple(settings(RECURRENT)),
    r"^twin .*kind=": tuple(settings(JUDGED)),
    r"^twin": tuple(settings(("twin.candidates=['static','arx']", *JUDGED))),
    r"^loop (run|tune) .*--machine C14": tuple(settings(LOOP)),
    r"^loop run .*fmu": ("--yes", *settings(LOOP)),
    r"^loop tune .*fmu": ("--yes", *TUNING, *settings(LOOP)),
    r"^loop run": tuple(settings(LOOP)),
    r"^loop tune": (*TUNING, *settings(LOOP)),
    r"^compress distil": tuple(settings(("training.epochs=1", "training.updates=3"))),
    r"^train finetune": tuple(settings(("finetune.single_phase_epochs=1",))),
    r"^simulate .*--limit": ("--duration", "6s", "--recordings", "1", *settings(LIMIT)),
    r"^simulate (?!.*--duration)": ("--duration", "6s", "--recordings", "2"),
    r"^evaluate (?!.*(runs/twin|TWIN))": ("--baselines", "persistence"),
    r"^rollout (?!.*--rollout-seconds)": ("--rollout-seconds", "2"),
    r"^verify": ("--format", "torch_ticks", "--format", "c", "--samples", "60"),
    r"^live .*--log": ("--until-end", "--speed", "inf"),
}
"""Further options by the begin of the command or a part of the line."""
