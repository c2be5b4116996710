"""Film of a scene as MP4 or GIF: frames rendered with NumPy, encoded by ffmpeg where the system has it."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import StorageError
from edp.report.animation.page import FRAMES_PER_S, Scene
from edp.report.animation.raster import Colour, Image, Points
from edp.storage import replacing

WIDTH, HEIGHT = 960, 600
FILMS = {
    ".mp4": ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart", "-f", "mp4"),
    # GIF counts delays in hundredths of a second: 12.5 frames a second are exactly eight of them.
    ".gif": ("-vf", "fps=12.5,split[a][b];[a]palettegen=max_colors=64[p];[b][p]paletteuse", "-f", "gif"),
}
"""Options of ffmpeg, by file ending."""
COLOURS = ((11, 87, 208), (184, 115, 26), (27, 110, 83))
NAMES = ("BOOM", "ARM", "BUCKET")
INK, SOFT, RULE, RED = (28, 37, 46), (102, 113, 125), (225, 230, 234), (179, 38, 30)
YELLOW, STEEL, SOIL = (240, 199, 94), (199, 206, 212), (232, 223, 208)
CHART_LEFT, CHART_S = 640, 8.0
Array = NDArray[np.float64]


def write_film(scene: Scene, output: str | Path) -> Path:
    """Encode a scene at its true speed.

    Raises:
        StorageError: ffmpeg is not installed or fails, or the film cannot be written.
    """
    target = Path(output)
    tool = shutil.which("ffmpeg")
    if tool is None:
        raise StorageError(
            f"writing '{target}' needs the program ffmpeg, which was not found; install it, or write .html"
        )
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", f"{FRAMES_PER_S:g}", "-i", "-")
    with replacing(target) as temporary:
        command = [tool, "-y", "-loglevel", "error", *raw, *FILMS[target.suffix.lower()], str(temporary)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as running:
            broken = ""
            try:
                for frame in frames(scene):
                    running.stdin.write(frame.tobytes())  # type: ignore[union-attr]
            # ffmpeg ended early; its own message says why.
            except BrokenPipeError as error:
                broken = str(error)
            _, error_output = running.communicate()
        if running.returncode or broken:
            raise StorageError(
                f"ffmpeg could not write '{target}': {error_output.decode(errors='replace').strip() or broken}"
            )
    return target


def frames(scene: Scene) -> Iterator[NDArray[np.uint8]]:
    """Return the pictures of a scene, each uint8 of shape (HEIGHT, WIDTH, 3)."""
    drawn = _Front(scene)
    for k in range(len(scene.angles)):
        image = Image(WIDTH, HEIGHT)
        drawn.draw(image, k)
        _charts(image, scene, k)
        time_s = scene.start_s + k / FRAMES_PER_S
        image.text(14, 12, f"{scene.machine.name.upper()}  {time_s:.1f} S", INK, 2)
        yield image.pixels()


class _Front:
    """Draws the machine of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.lengths = scene.machine.bodies.length
        reach = sum(self.lengths)
        self.foot = scene.machine.chassis.boom_foot_height
        self.left, self.top = -0.5 * reach, 0.8 * reach
        self.scale = HEIGHT / (1.64 * reach)
        self.unit = reach / 10.0
        turn = np.cumsum(scene.angles, axis=1)
        arms = np.array(self.lengths) * np.exp(1j * turn)
        self.tips = arms.sum(axis=1)

    def at(self, points: NDArray[np.complexfloating]) -> Points:
        """Return the pixels of points: complex numbers, metres in front of and above the boom foot."""
        z = np.asarray(points, dtype=np.complex128)
        return np.stack(((z.real - self.left) * self.scale, (self.top - z.imag) * self.scale), axis=-1)

    def draw(self, image: Image, k: int) -> None:
        """Draw the machine in frame `k`."""
        scene, u, level = self.scene, self.unit, -self.foot
        far, low = self.left + 1.66 * sum(self.lengths), level - 8.0 * u
        if scene.ground.shape[1]:
            line = scene.ground_x + 1j * scene.ground[k]
            line = line[line.real < far]
            edge = np.concatenate(([self.left + 1j * level, 1j * level], line, [far + 1j * line[-1].imag]))
            image.polygon(self.at(np.concatenate((edge, [far + 1j * low, self.left + 1j * low]))), SOIL)
        else:
            image.line(self.at(np.array([self.left + 1j * level, far + 1j * level])), RULE, 2.0)
        track = np.array([-2.9, 1.1, 1.4 + 0.45j, 1.1 + 0.9j, -2.9 + 0.9j, -3.2 + 0.45j]) * u + 1j * level
        house = np.array([-3.6, 0.5, 0.5 + 0.5j, -1.2 + 1.1j, -3.6 + 1.1j]) * u + 1j * (level + 1.05 * u)
        cab = np.array([-1.1 + 0.5j, 0.2 + 0.5j, 0.1 + 2.1j, -1.1 + 2.2j]) * u + 1j * (level + 1.05 * u)
        for points, colour in ((track, SOFT), (house, STEEL), (cab, RULE)):
            image.polygon(self.at(points), colour)
        trail = self.tips[max(0, k - round(8 * FRAMES_PER_S)) : k + 1 : 2]
        image.line(self.at(trail), RED, 1.5)
        self._front(image, scene.angles[k])

    def _front(self, image: Image, angles: Array) -> None:
        """Draw boom, arm, bucket and their cylinders; pin angles of frame and boom as on the page."""
        machine, u = self.scene.machine, self.unit
        boom_l, arm_l, bucket_l = self.lengths
        a, b, c = np.exp(1j * np.cumsum(angles))
        arm_at, boom, stick, bucket = boom_l * a, machine.boom_cylinder, machine.arm_cylinder, machine.bucket
        bucket_at = arm_at + arm_l * b
        deg = math.pi / 180.0
        pins = (
            (boom.base_radius * np.exp(-43j * deg), a * boom.rod_radius * np.exp(1j * deg * (boom.offset_deg - 43.0))),
            (
                arm_at + a * stick.base_radius * np.exp(155j * deg),
                arm_at + b * stick.rod_radius * np.exp(1j * deg * (155.0 - stick.offset_deg)),
            ),
        )
        elbow, lug, pivot, base = self._bucket_pins(angles[2])
        all_pins = (*pins, (arm_at + b * base, arm_at + b * elbow))
        shape = np.array([-0.02 + 0.03j, 1.0 + 0.022j, 1.0 - 0.022j, 0.6 + 0.085j, 0.42 + 0.095j, 0.02 - 0.03j])
        image.polygon(self.at(np.insert(shape * boom_l * a, 1, (pins[0][1], pins[1][0]))), YELLOW)
        shape = np.array([0.1 + 0.12j, 0.5 + 0.075j, 1 + 0.02j, 1 - 0.03j, 0.1 - 0.055j]) * arm_l
        shape = np.concatenate(([b.conjugate() * (pins[1][1] - arm_at)], shape))
        image.polygon(self.at(arm_at + b * shape), YELLOW)
        for (start, end), colour in zip(all_pins, COLOURS, strict=True):
            image.line(self.at(np.array([start, end])), SOFT, 0.07 * u * self.scale)
            image.line(self.at(np.array([start, start + 0.55 * (end - start)])), colour, 0.14 * u * self.scale)
        image.line(self.at(arm_at + b * np.array([pivot, elbow, lug])), SOFT, 0.09 * u * self.scale)
        heel = bucket_l - bucket.floor_length * np.exp(-1j * deg * bucket.floor_angle_deg)
        lug_here = machine.bucket_linkage.lug * np.exp(1j * machine.bucket_linkage.lug_angle)
        back = 0.5 * (heel + lug_here) + bucket_l * (-0.02 + 0.12j)
        image.polygon(self.at(bucket_at + c * np.array([-0.06j * bucket_l, bucket_l, heel, back, lug_here])), STEEL)
        image.line(self.at(bucket_at + c * np.array([bucket_l, heel])), INK, 2.5)

    def _bucket_pins(self, psi: float) -> tuple[complex, complex, complex, complex]:
        """Return the elbow, lug, rocker pivot and cylinder pin in the arm's frame."""
        link, arm_l = self.scene.machine.bucket_linkage, self.lengths[1]
        pivot = complex(arm_l - link.pivot_to_pin, link.pivot_offset)
        lug = complex(arm_l + link.lug * np.exp(1j * (psi + link.lug_angle)))
        across = lug - pivot
        along = 0.5 * (1.0 + (link.rocker**2 - link.link**2) / abs(across) ** 2)
        # Rounding at the end of a stroke may put the circles apart by a hair.
        aside = math.sqrt(max((link.rocker / abs(across)) ** 2 - along**2, 0.0))
        return pivot + across * complex(along, aside), lug, pivot, complex(*link.cylinder_pin)


def _charts(image: Image, scene: Scene, k: int) -> None:
    rows: list[tuple[str, Array, tuple[Colour, ...]]] = [("VELOCITY MM/S", scene.velocity, COLOURS)]
    for i in range(scene.pressure.shape[1] // 2):
        rows.append((f"{NAMES[i]} PRESSURE BAR", scene.pressure[:, 2 * i : 2 * i + 2], (COLOURS[i], SOFT)))
    tall = (HEIGHT - 20) / len(rows)
    first = min(max(0, k - round(0.7 * CHART_S * FRAMES_PER_S)), max(0, len(scene.angles) - 2))
    last = min(first + round(CHART_S * FRAMES_PER_S), len(scene.angles))
    for n, (title, values, colours) in enumerate(rows):
        top, bottom = 10 + n * tall + 22, 10 + (n + 1) * tall - 12
        low, high = float(values.min()), float(values.max())
        height = max(high - low, 1e-9)
        image.text(CHART_LEFT, int(top) - 18, title, INK, 2)
        for v in {low, high, 0.0} if low < 0 < high else {low, high}:
            y = bottom - (v - low) / height * (bottom - top)
            image.line(np.array([[CHART_LEFT + 44.0, y], [WIDTH - 10.0, y]]), RULE, 1.0)
            image.text(CHART_LEFT, int(y) - 4, f"{v:.0f}", SOFT, 1)
        x = (
            CHART_LEFT
            + 44.0
            + (np.arange(first, last) - first) / (CHART_S * FRAMES_PER_S) * (WIDTH - 54.0 - CHART_LEFT)
        )
        for column, colour in zip(values[first:last].T, colours):
            y = bottom - (column - low) / height * (bottom - top)
            image.line(np.stack((x, y), axis=1), colour, 1.6)
        image.line(np.array([[x[k - first], top], [x[k - first], bottom]]), RED, 1.0)
