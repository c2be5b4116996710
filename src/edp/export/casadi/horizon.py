"""A horizon of a network in compiled C, with its Jacobian. Needs NumPy, nothing else."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


class Horizon:
    """`Network.horizon` in C with the Jacobian by commands in one call: for a controller that linearises once a tick.

    Args:
        network: a `Network` that was compiled.
        library: what `Network.compile` made.
        steps: ticks.
        commands: names of inputs by which is differentiated.
        carry, feed: see `Network.horizon`.
    """

    def __init__(
        self, network: Any, library: str | Path, steps: int, commands: Sequence[str], carry: Any, feed: Any
    ) -> None:
        held, name = ctypes.CDLL(str(Path(library).resolve())), network.about["name"]
        self._run, size = held[f"{name}_horizon"], held[f"{name}_horizon_work"]
        self._run.restype, size.restype = ctypes.c_uint32, ctypes.c_longlong
        self.steps, self.width = steps, network.step.numel_out(1)
        self._sizes = len(network.start), len(network.inputs)
        columns = [network.inputs.index(command) for command in commands]
        self._shape, self._columns = np.array([steps, len(columns)], np.uint32), np.array(columns, np.uint32)
        self._carry = np.array(carry, dtype=float).reshape(self._sizes[1])
        self._feed = np.array(feed, dtype=float).reshape(self._sizes[1], self.width)
        self._fed = (ctypes.c_void_p * 2)(self._carry.ctypes.data, self._feed.ctypes.data)
        self._work = np.zeros(size(ctypes.c_uint32(steps), ctypes.c_uint32(len(columns))))

    def __call__(self, x: Any, first: Any, base: Any) -> tuple[np.ndarray, np.ndarray]:
        """Predictions ``(steps, prediction)`` and Jacobian ``(steps, prediction, steps, command)``.

        Args:
            x: the state ``(state,)`` before the first tick.
            first: its inputs ``(input,)``.
            base: ``(steps, input)``; row 0 is not read.

        Raises:
            ValueError: an argument has another size, or inputs are not finite or beyond their limits.
        """
        states, inputs = self._sizes
        given = [np.ascontiguousarray(value, dtype=float) for value in (x, first, base)]
        for value, size in zip(given, (states, inputs, self.steps * inputs), strict=True):
            if value.size != size:
                raise ValueError(f"an argument of a horizon has {value.size} numbers; {size} are needed")
        y, jacobian = np.empty((self.steps, self.width)), np.empty((self.steps, self.width, *self._shape))
        arrays = (given[0], self._shape, self._columns, given[1], given[2])
        places = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        ends = [ctypes.c_void_p(array.ctypes.data) for array in (y, jacobian, self._work)]
        refused = self._run(*places, self._fed, *ends)
        if refused:
            raise ValueError(f"inputs of tick {refused - 1} of the horizon are not finite or beyond their limits")
        return y, jacobian
