"""Decoys: channels laid over recordings that a screening must see through, of which it is known how each was made.

Four families: noise that knows nothing of the machine, delayed copies of channels that are there, leaks of the future
(what no sensor can show at that moment), and artefacts whose relation to the machine changes from file to file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind

Array = NDArray[np.float64]
FAMILIES = ("noise", "copy", "leak", "artefact")
TARGETS = ("CylVels_1", "CylVels_2", "CylVels_3")


@dataclass(frozen=True)
class Decoy:
    """One false channel.

    Attributes:
        name: of the channel; it does not tell the family.
        family: one of `FAMILIES`.
        recipe: how it was made.
        source: the channel that it was made from, where there is one.
        lead: samples by which it runs ahead of its source; negative for a delay.
    """

    name: str
    family: str
    recipe: str
    source: str = ""
    lead: int = 0


Make = Callable[[Sequence[Recording], np.random.Generator], list[Array]]
"""A false channel over every recording, each of shape ``(time,)``."""


@dataclass(frozen=True)
class Recipe:
    """How a decoy is made, in words and as code; see `Decoy`."""

    text: str
    make: Make
    source: str = ""
    lead: int = 0


def lay_decoys(recordings: Sequence[Recording], each: int = 20, seed: int = 0) -> tuple[list[Recording], list[Decoy]]:
    """Append `each` decoys of every family to the channels of recordings, in random order.

    Args:
        recordings: at least two, with the names of Table A.1.
        each: decoys a family.
        seed: of every choice.
    """
    rng = np.random.default_rng(seed)
    made: list[tuple[Decoy, list[Array]]] = []
    for family, plan in (("noise", _noises), ("copy", _copies), ("leak", _leaks), ("artefact", _artefacts)):
        for one in plan(recordings, each, rng):
            made.append((Decoy("", family, one.text, one.source, one.lead), one.make(recordings, rng)))
    order = rng.permutation(len(made))
    named = [(replace(made[i][0], name=f"Aux_{n:02d}"), made[i][1]) for n, i in enumerate(order)]
    channels = tuple(Channel(decoy.name, Kind.GENERIC) for decoy, _ in named)
    laid = []
    for i, recording in enumerate(recordings):
        columns = np.stack([values[i] for _, values in named], axis=1).astype(np.float32)
        values = np.concatenate([recording.values, columns], axis=1)
        laid.append(replace(recording, channels=recording.channels + channels, values=values))
    return laid, [decoy for decoy, _ in named]


def shifted(values: Array, lead: int) -> Array:
    """`values` that run `lead` samples ahead (behind, where negative); the ends hold the last value there is."""
    rows = np.clip(np.arange(len(values)) + lead, 0, len(values) - 1)
    return values[rows]


def _column(recording: Recording, name: str) -> Array:
    return recording.column(name).astype(np.float64)


def _sizes(recordings: Sequence[Recording], name: str) -> float:
    return float(np.std(np.concatenate([_column(r, name) for r in recordings]))) or 1.0


def _moving(recordings: Sequence[Recording], rng: np.random.Generator) -> list[str]:
    """Channels of Table A.1 that move, in random order."""
    names = [c.name for c in recordings[0].channels if c.name in TABLE_A1]
    largest = {name: max(float(np.abs(r.column(name)).max()) for r in recordings) for name in names}
    moving = [name for name in names if _sizes(recordings, name) > 1e-3 * largest[name] > 0]
    return [moving[i] for i in rng.permutation(len(moving))]


def _noises(recordings: Sequence[Recording], each: int, rng: np.random.Generator) -> list[Recipe]:
    """White, slow, stepped and one-sided noise, and channels of another session."""
    names = _moving(recordings, rng)

    def slow(seconds: float) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            keep = [np.exp(-1.0 / (seconds * r.rate_hz)) for r in recordings]
            drawn = [rng.normal(size=r.samples) for r in recordings]
            return [signal.lfilter([1.0], [1.0, -k], d) for k, d in zip(keep, drawn, strict=True)]

        return make

    def stepped(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
        found = []
        for r in recordings:
            jumps = rng.random(r.samples) < 1.0 / (0.8 * r.rate_hz)
            levels = rng.uniform(0.0, 30.0, jumps.sum() + 1)
            found.append(ndimage.uniform_filter1d(levels[np.cumsum(jumps)], 9, origin=4))
        return found

    def one_sided(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
        return [np.maximum(values, 0.0) for values in slow(0.4)(recordings, rng)]

    def white(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
        return [rng.normal(size=r.samples) for r in recordings]

    def foreign(name: str) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            step = int(rng.integers(1, len(recordings)))
            others = [recordings[(i + step) % len(recordings)] for i in range(len(recordings))]
            return [np.resize(_column(other, name), r.samples) for r, other in zip(recordings, others, strict=True)]

        return make

    plan: list[Recipe] = []
    for n in range(each):
        recipe = n % 6
        name = names[n % len(names)]
        plan.append(
            [
                Recipe("white noise", white),
                Recipe("noise of 0.5 s", slow(0.5)),
                Recipe("noise of 5 s", slow(5.0)),
                Recipe("steps between random levels", stepped),
                Recipe("one-sided noise", one_sided),
                Recipe(f"{name} of another session", foreign(name)),
            ][recipe]
        )
    return plan


def _copies(recordings: Sequence[Recording], each: int, rng: np.random.Generator) -> list[Recipe]:
    """Channels that are there, later: in another unit, with noise or coarse steps, some through a filter."""
    names = _moving(recordings, rng)

    def copy(name: str, delay: int, style: int) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            size, gain = _sizes(recordings, name), float(rng.uniform(0.2, 5.0)) * float(rng.choice([-1.0, 1.0]))
            found = []
            for r in recordings:
                values = gain * shifted(_column(r, name), -delay) / size + gain
                if style == 1:
                    values = values + 0.02 * gain * rng.normal(size=len(values))
                elif style == 2:
                    values = np.round(values / (0.05 * gain)) * 0.05 * gain
                elif style == 3:
                    values = signal.lfilter([0.2], [1.0, -0.8], values, zi=[0.8 * values[0]])[0]
                found.append(values)
            return found

        return make

    styles = ("", ", with noise", ", rounded", ", through a filter")
    plan: list[Recipe] = []
    for n in range(each):
        name, delay, style = names[n % len(names)], int(rng.integers(3, 41)), n % 4
        plan.append(Recipe(f"{name} delayed{styles[style]}", copy(name, delay, style), name, -delay))
    return plan


def _leaks(recordings: Sequence[Recording], each: int, rng: np.random.Generator) -> list[Recipe]:
    """Targets ahead of their time, and what filters without delay make of them."""

    def ahead(name: str, lead: int, noise: float) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            size = _sizes(recordings, name)
            return [shifted(_column(r, name), lead) / size + noise * rng.normal(size=r.samples) for r in recordings]

        return make

    def zero_phase(name: str, hz: float) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            sections = signal.butter(2, hz, fs=recordings[0].rate_hz, output="sos")
            return [signal.sosfiltfilt(sections, _column(r, name)) for r in recordings]

        return make

    def centred_mean(name: str, half: int) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            return [ndimage.uniform_filter1d(_column(r, name), 2 * half + 1) for r in recordings]

        return make

    def centred_slope(name: str, half: int) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            return [
                signal.savgol_filter(_column(r, name), 2 * half + 1, 2, deriv=1, delta=1 / r.rate_hz)
                for r in recordings
            ]

        return make

    plan: list[Recipe] = []
    for n in range(each):
        name, recipe = TARGETS[n % 3], n % 5
        lead, half = int(rng.integers(2, 31)), int(rng.integers(5, 21))
        if recipe in (0, 1):
            noise = 0.02 * recipe
            plan.append(Recipe(f"{name} ahead, noise {noise:g}", ahead(name, lead, noise), name, lead))
        elif recipe == 2:
            hz = float(rng.uniform(2.0, 5.0))
            plan.append(Recipe(f"{name}, zero-phase low-pass {hz:.1f} Hz", zero_phase(name, hz), name))
        elif recipe == 3:
            plan.append(Recipe(f"{name}, mean over {half} samples each way", centred_mean(name, half), name))
        else:
            plan.append(Recipe(f"slope of {name} over {half} samples each way", centred_slope(name, half), name))
    return plan


def _artefacts(recordings: Sequence[Recording], each: int, rng: np.random.Generator) -> list[Recipe]:
    """Numbers of the session, drifts with time, and relations that hold in some files or change sign between them."""

    def session(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
        return [np.full(r.samples, level) for r, level in zip(recordings, rng.normal(size=len(recordings)))]

    def drift(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
        slopes = rng.normal(size=len(recordings))
        return [
            start + slope * np.linspace(0, 1, r.samples)
            for r, slope, start in zip(recordings, slopes, rng.normal(size=len(recordings)))
        ]

    def turned(name: str) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            signs = rng.permutation(np.resize([-1.0, 1.0], len(recordings)))
            size = _sizes(recordings, name)
            return [
                sign * _column(r, name) / size + 0.3 * rng.normal(size=r.samples) for r, sign in zip(recordings, signs)
            ]

        return make

    def sometimes(name: str) -> Make:
        def make(recordings: Sequence[Recording], rng: np.random.Generator) -> list[Array]:
            chosen = rng.permutation(np.resize([1.0, 0.0, 0.0], len(recordings)))
            size = _sizes(recordings, name)
            return [
                on * _column(r, name) / size + (0.3 if on else 1.0) * rng.normal(size=r.samples)
                for r, on in zip(recordings, chosen)
            ]

        return make

    plan: list[Recipe] = []
    for n in range(each):
        name = TARGETS[n % 3]
        plan.append(
            [
                Recipe("a number of the session", session),
                Recipe("a drift of each session", drift),
                Recipe(f"{name} with another sign a file", turned(name), name),
                Recipe(f"{name} in a third of the files, else noise", sometimes(name), name),
            ][n % 4]
        )
    return plan
