"""Pictures of a film: polygons, lines and labels on an RGB picture, by Pillow, smoothed by two-fold sampling."""

from __future__ import annotations

from functools import cache

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageDraw, ImageFont

Points = NDArray[np.float64]
Colour = tuple[int, int, int]
# Pillow draws hard edges; the mean of 2 x 2 samples is as smooth as a film of this size needs.
FINE = 2
"""Number of samples per pixel in each direction."""
# Capitals of Pillow's default font are 0.7 of its size high.
FONT_PER_CELL = 7
"""Font size in pixels per unit of a label's size. Capitals are five pixels high."""


class Image:
    """White picture of `width` by `height` pixels; coordinates are pixels from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self._fine = PIL.Image.new("RGB", (width * FINE, height * FINE), (255, 255, 255))
        self._draw = ImageDraw.Draw(self._fine)

    def polygon(self, points: Points, colour: Colour) -> None:
        """Fill a polygon, shape (corner, 2)."""
        self._draw.polygon(_scale_points(points), fill=colour)

    def line(self, points: Points, colour: Colour, thick: float) -> None:
        """Draw a line through points, shape (point, 2), `thick` pixels wide."""
        self._draw.line(_scale_points(points), fill=colour, width=max(1, round(thick * FINE)), joint="curve")

    def text(self, x: int, y: int, words: str, colour: Colour, size: int) -> None:
        """Draw a label with its upper left corner at `x`, `y`; its capitals are five times `size` pixels high."""
        self._draw.text((x * FINE, y * FINE), words, fill=colour, font=_font(size), anchor="lt")

    def pixels(self) -> NDArray[np.uint8]:
        """Return the picture, uint8, shape (height, width, 3)."""
        return np.asarray(self._fine.reduce(FINE), dtype=np.uint8)


def _scale_points(points: Points) -> list[tuple[float, float]]:
    # Pillow counts from the centre of the first sample, pictures from its corner.
    return [(float(x) * FINE - 0.5, float(y) * FINE - 0.5) for x, y in np.asarray(points, dtype=float)]


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(FONT_PER_CELL * size * FINE)
