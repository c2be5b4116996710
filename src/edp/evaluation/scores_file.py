"""Reading ``scores.json``: the shapes that reports and tables rely on are checked before anything is drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edp.errors import StorageError
from edp.settings.bounds import shown
from edp.storage import read_object
from edp.storage.paths import is_file_at


@dataclass(frozen=True)
class Leaf:
    """A plain value: whether it may stand there, and the words for what must."""

    fits: Callable[[Any], bool]
    words: str


@dataclass(frozen=True)
class NamedValues:
    """An object whose keys are names; every value has one shape.

    Attributes:
        value: the shape.
        needed: keys that must be there.
    """

    value: Shape
    needed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Listed:
    """A list; every entry has one shape."""

    value: Shape


@dataclass(frozen=True)
class KeyedObject:
    """An object with known keys; others are passed over.

    Attributes:
        keys: shapes by key.
        needed: keys that must be there.
    """

    keys: dict[str, Shape]
    needed: tuple[str, ...] = ()


Shape = Leaf | NamedValues | Listed | KeyedObject


def _is_number(value: Any) -> bool:
    # true and false are integers to Python.
    return isinstance(value, int | float) and not isinstance(value, bool)


NUMBER = Leaf(lambda value: value is None or _is_number(value), "a number or null")
REAL = Leaf(_is_number, "a number")
COUNT = Leaf(lambda value: isinstance(value, int) and _is_number(value) and value >= 0, "an integer, 0 or more")
SIZE = Leaf(lambda value: _is_number(value) and value > 0, "a number above 0")
NAME = Leaf(lambda value: isinstance(value, str), "a text")
METRICS = NamedValues(NUMBER)
"""Metrics by name."""
BOUNDS = ("coverage", "covered", "width")
MEANS = NamedValues(REAL, ("mean",))
"""Of each target, and of all."""
MODEL = KeyedObject(
    {
        "label": NAME,
        "seconds": NUMBER,
        "overall": NamedValues(NamedValues(METRICS)),
        "validation": NamedValues(NamedValues(METRICS)),
        "recordings": NamedValues(NamedValues(NamedValues(METRICS))),
        "spread": NamedValues(METRICS),
        "by_speed": NamedValues(
            Listed(KeyedObject({"low": REAL, "high": REAL, "count": COUNT, "mae": NUMBER}, ("low", "high", "count")))
        ),
        "by_situation": NamedValues(
            Listed(
                KeyedObject(
                    {
                        "situation": NAME,
                        "ticks": COUNT,
                        "share": REAL,
                        "of_error": REAL,
                        "mae": NamedValues(NUMBER),
                    },
                    ("situation", "share", "of_error", "mae"),
                )
            )
        ),
        "intervals": NamedValues(Listed(KeyedObject({"coverage": REAL, "covered": MEANS, "width": MEANS}, BOUNDS))),
        "weighted_interval_score": NamedValues(MEANS),
        "integrated": NamedValues(METRICS),
    },
    ("overall",),
)
SITUATION = KeyedObject(
    {
        "outside": Listed(KeyedObject({"channel": NAME, "share": REAL}, ("channel", "share"))),
        "changes": Listed(
            KeyedObject(
                {"target": NAME, "horizon": COUNT, "ratio": REAL, "beyond": REAL},
                ("target", "horizon", "ratio", "beyond"),
            )
        ),
    },
    ("outside", "changes"),
)
SCORES = KeyedObject(
    {
        "task": KeyedObject(
            {"name": NAME, "horizons": Listed(COUNT), "rate_hz": SIZE, "mode": NAME, "skip": COUNT}, ("horizons",)
        ),
        "targets": Listed(KeyedObject({"name": NAME, "description": NAME, "unit": NAME, "factor": SIZE}, ("name",))),
        "inputs": Listed(KeyedObject({"name": NAME, "unit": NAME, "factor": SIZE}, ("name", "unit", "factor"))),
        "models": NamedValues(MODEL),
        "situation": SITUATION,
    },
    ("task", "targets", "models"),
)


def read_scores(path: str | Path) -> dict[str, Any]:
    """The content of a ``scores.json``, in the form in which `edp.evaluation.judge` writes it.

    Raises:
        StorageError: it cannot be read, or a value in it has another form; the message names the value.
    """
    return read_shaped(path, SCORES)


def earlier_scores(folder: Path, key: str) -> dict[str, Any] | None:
    """Scores of an earlier judgement with this key, beside their predictions; None where there are none."""
    if not is_file_at(folder / "scores.json") or not is_file_at(folder / "predictions.safetensors"):
        return None
    scores = read_scores(folder / "scores.json")
    return scores if scores.get("key") == key else None


def read_shaped(path: str | Path, shape: Shape) -> dict[str, Any]:
    """The content of a JSON file of scores whose values have the forms that a shape tells.

    Raises:
        StorageError: it cannot be read, or a value in it has another form; the message names the value.
    """
    content = read_object(path)
    _check(content, shape, "", f"'{path}'")
    return content


def _check(value: Any, shape: Shape, where: str, file: str) -> None:
    if isinstance(shape, Leaf):
        if not shape.fits(value):
            _refuse(value, shape.words, where, file)
    elif isinstance(shape, Listed):
        if not isinstance(value, list):
            _refuse(value, "a list", where, file)
        for number, entry in enumerate(value):
            _check(entry, shape.value, f"{where}[{number}]", file)
    else:
        if not isinstance(value, dict):
            _refuse(value, "an object", where, file)
        shapes = dict.fromkeys(value, shape.value) if isinstance(shape, NamedValues) else shape.keys
        for key in shape.needed:
            if key not in value:
                _refuse(value, f"an object with the key '{key}'", where, file)
        for key in value.keys() & shapes.keys():
            _check(value[key], shapes[key], f"{where}.{key}".lstrip("."), file)


def _refuse(value: Any, words: str, where: str, file: str) -> None:
    raise StorageError(
        f"{file}: {where or 'the whole'} is {shown(value)}; {words} must hold. The file was changed by hand or is of "
        "another version: remove it and run edp evaluate"
    )


def nearest_to_shown(coverages: Sequence[float]) -> int:
    """Which of several intervals pictures show: that nearest to 90 %."""
    return min(range(len(coverages)), key=lambda which: abs(coverages[which] - 0.9))
