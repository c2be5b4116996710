"""Seeded command lines over every command of the Typer tree, with hostile paths, numbers and names.

`world` lays out the places that arguments name, `drawn` draws one command line from a seed. A new command or option is
drawn without a change here.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
import typer

from edp.cli import app
from edp.config.experiment import load_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.workflows.fleet.registry import add_to_registry
from edp.workflows.train_evaluate import evaluate, train

NUMBERS = (
    "1",
    "2",
    "3",
    "0",
    "-1",
    "1e-320",
    "1e308",
    "nan",
    "inf",
    "-inf",
    str(10**18),
    "3.5",
    "",
    "abc",
    "1e400",
    "0x10",
)
TEXTS = ("", "-", "--", "ü" * 90, "x" * 400, "a\nb", "\x1b[2J", "\u202eabc", "../../etc", "{}", "[1", "CylVels_1")
SETTINGS = (
    "training.epochs=1",
    "training.epochs=1e308",
    "evaluation.warmup_samples=1e9",
    "task.horizons=[0]",
    "task.horizons=[1000000000000000000]",
    "model.window=-1",
    "training.minutes=1e-320",
    "training.minutes=nan",
    "nothing=1",
    "=",
    "a.b.c.d=[",
    "training.seed=10000000000000000000000000000000000000000000",
    "seed=-1",
    "task.targets=[]",
)
SMALL = (
    *("training.epochs=1", "training.updates=2", 'training.optimizer={kind="adamw"}', "evaluation.history=5"),
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'task={targets=["CylVels_1"],horizons=[1],features="all"}',
    *('model.backbone={kind="lstm",units=4}', "model.head.hidden=4", "model.window=5"),
)
"""Of the run of a world: a training of a second."""
FOLDERS = {
    "out": "out/new",
    "page": "out/page.html",
    "study": "half_study",
    "registry": "half_registry",
    "data": "logs",
    "logs": "logs",
    "log": "logs/log0.csv",
    "paths": "logs/log0.csv",
    "store": "store",
    "folder": "store",
    "run": "run",
    "bundle": "run",
    "runs": "run",
    "source": "run",
    "twin": "half_twin",
    "arguments": "logs",
}
"""Usable places by the name of a parameter."""


@dataclass(frozen=True)
class Command:
    """A command of the tree: its words and its parameters."""

    words: tuple[str, ...]
    parameters: tuple[Any, ...]


def commands() -> list[Command]:
    """Return all commands without subcommands, in the order of the tree."""

    def leaves(node: Any, words: tuple[str, ...]) -> Iterator[Command]:
        below = getattr(node, "commands", None)
        if below is None:
            yield Command(words, tuple(node.params))
        else:
            for name, inner in below.items():
                yield from leaves(inner, (*words, name))

    return list(leaves(typer.main.get_command(app), ()))


def short_log(path: Path, seed: int, samples: int = 600) -> None:
    """Write a log of a lever and a velocity that lags behind it."""
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.uniform(0, 1, samples // 20 + 1), 20)[:samples].astype(np.float32)
    velocity = np.convolve(lever, np.full(10, 0.005, np.float32))[:samples].astype(np.float32)
    channels = (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"])
    write_recording(Recording(path.stem, channels, np.column_stack([lever, velocity]), 100.0), path)


def world(top: Path) -> None:
    """Lay out good and bad places below a folder: everything that an argument or option of a path may name."""
    for number in range(4):
        short_log(top / "logs" / f"log{number}.csv", number)
    DataSource.from_path(top / "logs").store(top / "store")
    train(DataSource.from_path(top / "logs"), load_experiment(preset="quick", overrides=SMALL), top / "run")
    evaluate(top / "run", baselines=["persistence"])
    add_to_registry(top / "registry", top / "run", "first")
    (top / "empty").mkdir()
    (top / "foreign").mkdir()
    (top / "foreign" / "notes.txt").write_text("mine")
    (top / "foreign" / "store.json").write_text("[]")
    (top / "file.bin").write_bytes(b"\x00\xff" * 50)
    (top / "empty.csv").write_text("")
    (top / "empty.toml").write_text("")
    (top / "wrong.toml").write_text("[training\n")
    (top / "odd.json").write_text('{"schema": 1e400}')
    (top / "loop").symlink_to(top / "loop2")
    (top / "loop2").symlink_to(top / "loop")
    (top / "dangling").symlink_to(top / "nowhere")
    os.mkfifo(top / "pipe")
    (top / "logs_with_pipe").mkdir()
    os.mkfifo(top / "logs_with_pipe" / "log.csv")
    short_log(top / "logs_with_pipe" / "other.csv", 5)
    (top / "part_closed").mkdir()
    short_log(top / "part_closed" / "a.csv", 6)
    (top / "part_closed" / "below").mkdir()
    short_log(top / "closed_file" / "a.csv", 7)
    for name in ("run", "study", "registry", "monitor", "twin"):
        (top / f"half_{name}").mkdir()
    (top / "half_run" / "run.json").write_text('{"schema": 1, "key": "0"}')
    (top / "half_run" / "provenance.json").write_text('{"data": {}, "seconds": 1}')
    (top / "half_study" / "study.json").write_text('{"schema": 2, "state": "running", "mode": "sound"}')
    (top / "half_registry" / "entries").mkdir()
    (top / "half_registry" / "entries" / ("0" * 32 + ".json")).write_text("{}")
    (top / "half_monitor" / "monitor.json").write_text('{"schema": 1}')
    (top / "half_twin" / "twin").mkdir()
    (top / "half_twin" / "twin" / "twin.json").write_text("{}")
    for folder in ("closed", "read_only"):
        (top / folder).mkdir()
        (top / folder / "run.json").write_text("{}")


def close(top: Path) -> None:
    """Take rights away; last, since nothing can be laid out below afterwards."""
    for name, mode in (("closed", 0), ("read_only", 0o555), ("part_closed/below", 0), ("closed_file/a.csv", 0)):
        (top / name).chmod(mode)


def odd_paths(top: Path) -> list[str]:
    """Return all places of a world, places in them, and paths that lead nowhere."""
    inside = [str(path) for path in sorted(top.iterdir()) if path.name != "out"]
    closed = [str(top / "closed" / "below"), str(top / "read_only" / "new"), str(top / "file.bin" / "below")]
    beyond = ["/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem", "/nowhere/at/all", str(top / ("n" * 300))]
    names = [str(top / name) for name in ("new folder", "neü", "a\nb", "\x1b[31m", "\udcff", ".", "..", "dangling/x")]
    return [*inside, *closed, *beyond, *names, "", "-", "s3://", "https://127.0.0.1:1/x", "/" * 5000]


def drawn(seed: int, top: Path, every: Sequence[Command]) -> list[str]:
    """Return the words of a command line: commands in turn, everything else drawn from the seed."""
    rng = random.Random(seed)
    command = every[seed % len(every)]
    places = odd_paths(top)
    words = list(command.words)
    for parameter in command.parameters:
        name = parameter.name or ""
        option = next((text for text in parameter.opts if text.startswith("--")), "")
        flag = kind_of(parameter) is bool
        if option and not parameter.required and rng.random() > (0.6 if name == "out" else 0.1):
            continue
        if flag:
            words.append(option)
            continue
        value = value_of(rng, parameter, name, top, places)
        words += [option, value] if option else [value]
        if not option and parameter.nargs != 1 and rng.random() < 0.7:
            words.append(value_of(rng, parameter, name, top, places))
    return words


def kind_of(parameter: Any) -> Any:
    """Return the type of one value of a parameter, as its function states it."""
    kind = parameter.type_descriptor.annotation
    while get_origin(kind) is not None or isinstance(kind, UnionType):
        if isinstance(kind, UnionType) or get_origin(kind) in (Union, list, tuple, Annotated):
            kind = next((part for part in get_args(kind) if part is not type(None)), str)
        else:
            return str
    return kind


def value_of(rng: random.Random, parameter: Any, name: str, top: Path, places: Sequence[str]) -> str:
    """Return a value for a parameter: usable in more than half of the cases, else odd."""
    kind = kind_of(parameter)
    if rng.random() < 0.05:
        return rng.choice([*NUMBERS, *TEXTS, *places])
    if "--set" in parameter.opts:
        return rng.choice(SETTINGS)
    if kind in (int, float):
        return rng.choice(NUMBERS)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return str(rng.choice([*(member.value for member in kind), "nothing"]))
    if kind is Path or name in FOLDERS:
        good = FOLDERS.get(name)
        return str(top / good) if good and rng.random() < 0.6 else rng.choice(places)
    return rng.choice([*TEXTS, *places[:3], "m22", "lstm", "CylVels_1", "1"])
