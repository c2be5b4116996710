"""A small painter: filled polygons, thick lines and block letters on an RGB picture, smoothed by two-fold sampling."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Colour = tuple[int, int, int]
FINE = 2
"""Samples per pixel and direction."""
THIN = 3.0
"""Lines below this many pixels have no shape of their own at bends and ends."""
LETTERS = {
    "A": "75755", "B": "65656", "C": "74447", "D": "65556", "E": "74747", "F": "74744", "G": "74757", "H": "55755",
    "I": "72227", "J": "11157", "K": "55655", "L": "44447", "M": "57555", "N": "65555", "O": "75557", "P": "75744",
    "Q": "75571", "R": "75655", "S": "74717", "T": "72222", "U": "55557", "V": "55552", "W": "55575", "X": "55255",
    "Y": "55222", "Z": "71247", "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717",
    "6": "74757", "7": "71111", "8": "75757", "9": "75717", ".": "00002", "-": "00700", "/": "11244", "_": "00007",
}  # fmt: skip
"""Five rows of three bits."""


class Image:
    """A white picture of `width` by `height` pixels to paint on; coordinates are pixels from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self._fine: NDArray[np.uint8] = np.full((height * FINE, width * FINE, 3), 255, dtype=np.uint8)

    def polygon(self, points: Points, colour: Colour) -> None:
        """Fill a polygon, shape (corner, 2), by the even-odd rule."""
        corners = np.asarray(points, dtype=float) * FINE
        height, width = self._fine.shape[:2]
        first = max(0, int(np.floor(corners[:, 1].min())))
        last = min(height, int(np.ceil(corners[:, 1].max())) + 1)
        left = max(0, int(np.floor(corners[:, 0].min())))
        right = min(width, int(np.ceil(corners[:, 0].max())) + 1)
        if first >= last or left >= right:
            return
        y = np.arange(first, last) + 0.5
        x = np.arange(left, right) + 0.5
        inside = np.zeros((len(y), len(x)), dtype=bool)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0)):
            crosses = (y0 <= y) != (y1 <= y)
            if crosses.any():
                cut = x0 + (y[crosses] - y0) * (x1 - x0) / (y1 - y0)
                inside[crosses] ^= x[None, :] > cut[:, None]
        self._fine[first:last, left:right][inside] = colour

    def line(self, points: Points, colour: Colour, thick: float) -> None:
        """A line through points, shape (point, 2), `thick` pixels wide."""
        path = np.asarray(points, dtype=float)
        if thick < THIN:
            self._stroke(path * FINE, colour, round(thick * FINE))
            return
        for (x0, y0), (x1, y1) in pairwise(path):
            length = float(np.hypot(x1 - x0, y1 - y0))
            if length < 1e-9:
                continue
            # a little longer than the piece, so that bends have no gaps
            dx, dy = 0.5 * thick * (x1 - x0) / length, 0.5 * thick * (y1 - y0) / length
            more = 0.5
            ends = [
                (x0 - more * dx - dy, y0 - more * dy + dx),
                (x1 + more * dx - dy, y1 + more * dy + dx),
                (x1 + more * dx + dy, y1 + more * dy - dx),
                (x0 - more * dx + dy, y0 - more * dy - dx),
            ]
            self.polygon(np.array(ends), colour)

    def _stroke(self, path: Points, colour: Colour, cells: int) -> None:
        """A thin line: squares of `cells` samples set along it, all at once."""
        walked = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
        along = np.linspace(0.0, walked[-1], max(2, int(walked[-1]) + 1))
        dots = np.stack([np.interp(along, walked, path[:, i]) for i in (0, 1)], axis=1)
        corner = np.floor(dots - 0.5 * cells).astype(int)
        height, width = self._fine.shape[:2]
        for dx in range(cells):
            for dy in range(cells):
                x, y = corner[:, 0] + dx, corner[:, 1] + dy
                inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
                self._fine[y[inside], x[inside]] = colour

    def text(self, x: int, y: int, words: str, colour: Colour, size: int) -> None:
        """Block letters of 3 by 5 cells of `size` pixels; unknown ones stay blank."""
        cell = size * FINE
        for n, letter in enumerate(words.upper()):
            for row, bits in enumerate(LETTERS.get(letter, "")):
                for column in range(3):
                    if int(bits) >> (2 - column) & 1:
                        top, left = y * FINE + row * cell, x * FINE + (4 * n + column) * cell
                        self._fine[max(0, top) : top + cell, max(0, left) : left + cell] = colour

    def pixels(self) -> NDArray[np.uint8]:
        """The picture, uint8, shape (height, width, 3)."""
        total = np.zeros((self._fine.shape[0] // FINE, self._fine.shape[1] // FINE, 3), dtype=np.uint16)
        for row in range(FINE):
            for column in range(FINE):
                total += self._fine[row::FINE, column::FINE]
        return np.asarray(total // FINE**2, dtype=np.uint8)
