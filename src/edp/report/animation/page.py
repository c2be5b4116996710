"""Side view of a recording on one offline HTML page, with its pressures and velocities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.report.common.templates import asset, json_text, stylesheet, template
from edp.signals import GROUND_POINTS, display_offset
from edp.storage import write_bytes
from edp.wording import figure

if TYPE_CHECKING:
    from edp.sim import Machine

Array = NDArray[np.float64]
JOINTS = ("boom", "arm", "bucket")
FRAMES_PER_S = 25.0
LONGEST_S = 600.0
"""Maximum duration of a segment on one page, s. Longer segments would make the page slow to open."""
OUTSIDE = 0.03
"""Tolerance in m for logged strokes outside the end stops, because stops are elastic and sensors have errors."""


@dataclass(frozen=True, eq=False)
class ForecastLine:
    """A prediction along a recording, each value at the tick for which it was made; arrays have shape (ticks,).

    Attributes:
        name: name of the predicted channel, in words.
        unit: unit of all values.
        predicted: NaN where there is none.
        measured: measured values.
        lower: bounds of the interval; None without one, `upper` likewise.
        upper: see `lower`.
    """

    name: str
    unit: str
    predicted: Array
    measured: Array
    lower: Array | None = None
    upper: Array | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Recording as the side view shows it, at `FRAMES_PER_S`; each array has shape (frame, columns).

    Attributes:
        name: name of the recording.
        machine: machine whose geometry is drawn.
        start_s: time of the first frame in the recording.
        angles: angles of boom, arm and bucket, rad.
        velocity: velocities of the cylinders, mm/s.
        pressure: head and rod of boom, arm and bucket, bar; no columns where the recording has none.
        ground: heights above the boom foot, m; no columns without soil.
        ground_x: positions of the ground points, m before the boom foot.
        readings: further values by name, with their unit.
        forecasts: lines of predictions, at the frames.
    """

    name: str
    machine: Machine
    start_s: float
    angles: Array
    velocity: Array
    pressure: Array
    ground: Array
    ground_x: Array
    readings: dict[str, Array]
    forecasts: tuple[ForecastLine, ...] = ()


def scene_of(
    recording: Recording,
    machine: str | None = None,
    start_s: float = 0.0,
    seconds: float | None = None,
    forecasts: Sequence[ForecastLine] = (),
) -> Scene:
    """Return the scene of a recording for a page or a film.

    Args:
        recording: recording with joint angles (`JointAngle_1..3`) or strokes (`CylStroke_1..3`).
        machine: name or file of the machine; default: the one the recording was simulated with.
        start_s: first second shown.
        seconds: length, s; by default to the end, at most `LONGEST_S`.
        forecasts: along the recording, to be drawn beside what then happened.

    Raises:
        DataError: neither angles nor strokes, or strokes that this machine does not have.
        ConfigError: a machine is needed and not known, or the segment lies outside the recording.
    """
    # The simulator brings Numba, a second of every command that writes a page of another kind.
    from edp.sim import load_machine
    from edp.sim.physics.soil import BEYOND_M, SPACING_M

    chosen = load_machine(machine or _machine_of(recording))
    if not 0.0 <= start_s < recording.duration_s or (seconds is not None and not seconds > 0.0):
        raise ConfigError(
            f"start {figure(start_s)} s and seconds {seconds} of '{recording.name}': it lasts "
            f"{figure(recording.duration_s)} s; "
            "the start must lie within, the length be positive"
        )
    length = min(seconds or LONGEST_S, LONGEST_S, recording.duration_s - start_s)
    when = start_s + np.arange(max(2, math.floor(length * FRAMES_PER_S))) / FRAMES_PER_S
    # Rounding at the end may point one sample beyond the recording.
    rows = np.minimum(np.round(when * recording.rate_hz).astype(int), recording.samples - 1)
    shown = _Columns(recording, rows)
    strokes_per_s = recording.rate_hz
    angles = _angles(shown, chosen)
    if shown.has("CylVels_1", "CylVels_2", "CylVels_3"):
        velocity = shown.take("CylVels_1", "CylVels_2", "CylVels_3")
    else:
        whole = np.stack([_fill_gaps(recording.column(f"CylStroke_{i}")) for i in (1, 2, 3)], axis=1)
        velocity = np.gradient(whole, axis=0)[rows] * strokes_per_s
    pressures = [f"CylPressures_{k}" for i in (1, 2, 3) for k in (i, i + 4)]
    ground = [f"Ground_{k:02d}" for k in range(GROUND_POINTS)]
    soil = shown.has(*ground)
    points = math.ceil((sum(chosen.bodies.length) + BEYOND_M) / SPACING_M)
    index = np.arange(GROUND_POINTS) * (points - 1) // (GROUND_POINTS - 1)
    extra = {"payload kg": ("Payload", 1.0, 0.0), "oil °C": ("OilTemperature", 1.0, display_offset("degC"))}
    readings = {k: f * shown.take(n)[:, 0] + add for k, (n, f, add) in extra.items() if shown.has(n)}
    if shown.has("TipForceX", "TipForceY"):
        readings["tip force kN"] = np.hypot(*shown.take("TipForceX", "TipForceY").T) * 1e-3
    return Scene(
        name=recording.name,
        machine=chosen,
        start_s=start_s,
        angles=angles,
        velocity=1e3 * velocity,
        pressure=1e-5 * shown.take(*pressures) if shown.has(*pressures) else np.zeros((len(rows), 0)),
        ground=shown.take(*ground) if soil else np.zeros((len(rows), 0)),
        ground_x=np.asarray(index * SPACING_M, dtype=np.float64),
        readings=readings,
        forecasts=tuple(_select_rows(line, rows) for line in forecasts),
    )


def _select_rows(line: ForecastLine, rows: NDArray[np.int_]) -> ForecastLine:
    def select(values: Array | None) -> Array | None:
        return None if values is None else values[rows]

    return replace(
        line,
        predicted=line.predicted[rows],
        measured=line.measured[rows],
        lower=select(line.lower),
        upper=select(line.upper),
    )


class _Columns:
    """Some rows of a recording's channels, missing values filled."""

    def __init__(self, recording: Recording, rows: NDArray[np.int_]) -> None:
        self.recording, self._rows = recording, rows

    def has(self, *names: str) -> bool:
        return set(names) <= set(self.recording.channel_names)

    def take(self, *names: str) -> Array:
        return np.stack([_fill_gaps(self.recording.column(name))[self._rows] for name in names], axis=1)


def _fill_gaps(values: Any) -> Array:
    """Return values with gaps filled by straight lines between their neighbours; all zeros without any value."""
    samples = np.asarray(values, dtype=float)
    finite = np.isfinite(samples)
    if finite.all():
        return samples
    return (
        np.interp(np.arange(len(samples)), np.flatnonzero(finite), samples[finite])
        if finite.any()
        else np.zeros(len(samples))
    )


def _machine_of(recording: Recording) -> str:
    named = recording.meta.get("machine")
    if isinstance(named, str):
        return named
    if recording.source.startswith("sim:"):
        return recording.source.removeprefix("sim:")
    raise ConfigError(
        f"recording '{recording.name}' does not say which machine it is of; give --machine with a name or the path of "
        "a machine file (.toml): its geometry is drawn"
    )


def _angles(shown: _Columns, machine: Machine) -> Array:
    """Return the joint angles, shape (frame, 3), from the angles themselves or from strokes."""
    angles, strokes = ([f"{kind}_{i}" for i in (1, 2, 3)] for kind in ("JointAngle", "CylStroke"))
    if shown.has(*angles):
        return shown.take(*angles)
    if not shown.has(*strokes):
        raise DataError(
            f"recording '{shown.recording.name}' has neither {', '.join(angles)} nor {', '.join(strokes)}; an "
            "animation needs one set: map your columns to these names in a signal map (--map)"
        )
    angle_tables = stroke_tables(machine)
    joint_angles = []
    for i, name in enumerate(strokes):
        values, (grid, psi) = shown.take(name)[:, 0], angle_tables[i]
        if values.min() < -OUTSIDE or values.max() > grid[-1] + OUTSIDE:
            raise DataError(
                f"channel '{name}' of '{shown.recording.name}' runs from {values.min():.3f} to {values.max():.3f} m, "
                f"the {JOINTS[i]} cylinder of {machine.name} from 0 to {grid[-1]:.3f} m; choose another --machine, or "
                "correct unit and zero in the signal map"
            )
        joint_angles.append(np.interp(values, grid, psi))
    return np.stack(joint_angles, axis=1)


def stroke_tables(machine: Machine) -> tuple[tuple[Array, Array], ...]:
    """Return 201 strokes (m, ascending) and joint angles (rad) for boom, arm and bucket."""
    from edp.sim.machine import layout as at
    from edp.sim.machine.parameters import pack
    from edp.sim.physics import linkage

    axes, plant = pack(machine)
    angle_tables = []
    for i in range(len(JOINTS)):
        full = float(axes[i, at.STROKE])
        grid = np.linspace(0.0, full, 201)
        if i < 2:
            psi = np.array([linkage.angle_at_stroke(i, s, axes, plant) for s in grid])
        else:
            branch, length = linkage.bucket_branch(axes[i, at.CLOSED], axes[i, at.CLOSED] + full, plant)
            psi = np.interp(grid + axes[i, at.CLOSED], length[::-1], branch[::-1])
        angle_tables.append((grid, psi))
    return tuple(angle_tables)


def write_animation(scene: Scene, output: str | Path) -> Path:
    """Write one HTML page that plays a scene with no network.

    Raises:
        StorageError: the page cannot be written.
    """
    seconds = len(scene.angles) / FRAMES_PER_S
    page = template("animation.html.jinja").render(
        name=scene.name,
        machine=f"{scene.machine.name}, {scene.machine.description}",
        stretch=f"{figure(scene.start_s)} to {figure(scene.start_s + seconds)} s",
        style=Markup(stylesheet("side_view.css", "animation.css")),
        **animation_parts(scene),
    )
    target = Path(output)
    write_bytes(target, page.encode("utf-8", "replace"))
    return target


def animation_parts(scene: Scene) -> dict[str, Markup]:
    """Return script and data of a scene for the macros of ``side_view.jinja``."""
    return {"script": Markup(asset("side_view.js") + asset("animation.js")), "data": json_text(_plain(scene))}


def side_view(scene: Scene) -> Markup:
    """Return the side view of a scene as a part of a page with the style ``side_view.css``."""
    return Markup(template("side_view.jinja").module.side_view(**animation_parts(scene)))  # type: ignore[attr-defined]


def _plain(scene: Scene) -> dict[str, object]:
    machine = scene.machine
    return {
        "rate": FRAMES_PER_S,
        "start": scene.start_s,
        "geometry": geometry_of(machine),
        # Decimals finer than a pixel would only enlarge the page.
        "angles": np.round(scene.angles.T, 4).tolist(),
        "velocity": np.round(scene.velocity.T, 1).tolist(),
        "pressure": np.round(scene.pressure.T, 1).tolist(),
        "ground": np.round(scene.ground[::5], 2).tolist(),
        "ground_every": 5,
        "ground_x": np.round(scene.ground_x, 3).tolist(),
        "readings": {name: np.round(values, 1).tolist() for name, values in scene.readings.items()},
        "forecasts": [
            {
                "name": line.name,
                "unit": line.unit,
                **{part: _gappy(getattr(line, part)) for part in ("predicted", "measured", "lower", "upper")},
            }
            for line in scene.forecasts
        ],
    }


def _gappy(values: Array | None) -> list[float | None] | None:
    """Return values rounded to the resolution of a picture, None for missing ones."""
    if values is None:
        return None
    finite = np.abs(values[np.isfinite(values)])
    # A thousandth of the largest value is finer than a pixel.
    places = 3 - math.floor(math.log10(finite.max())) if finite.size and finite.max() > 0.0 else 0
    return [round(float(v), places) if math.isfinite(v) else None for v in values]


def geometry_of(machine: Machine) -> dict[str, object]:
    """Return the machine's lengths (m) and angles (degrees) for ``side_view.js`` as plain JSON values."""
    return {
        "length": machine.bodies.length,
        "boom": asdict(machine.boom_cylinder),
        "arm": asdict(machine.arm_cylinder),
        "linkage": asdict(machine.bucket_linkage),
        "bucket": asdict(machine.bucket),
        "foot": machine.chassis.boom_foot_height,
    }
