"""Prediction over a horizon in compiled C, with its Jacobian. Needs NumPy only."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np


class Horizon:
    """`Network.horizon` in C with the Jacobian by commands in one call: for a controller that linearises once a tick.

    Args:
        network: a `Network` that was compiled.
        library: result of `Network.compile`.
        steps: ticks.
        commands: numbers that are chosen for each tick, by which is differentiated.
        carry, feed: see `Network.horizon`.
    """

    def __init__(self, network: Any, library: str | Path, steps: int, commands: int, carry: Any, feed: Any) -> None:
        loaded, name = ctypes.CDLL(str(Path(library).resolve())), network.about["name"]
        self._run, size = loaded[f"{name}_horizon"], loaded[f"{name}_horizon_work"]
        self._run.restype, size.restype = ctypes.c_uint32, ctypes.c_longlong
        self.steps, self.width = steps, network.step.numel_out(1)
        self._sizes = len(network.start), len(network.inputs)
        self._shape = np.array([steps, commands], np.uint32)
        self._carry = np.array(carry, dtype=float).reshape(self._sizes[1])
        self._feed = np.array(feed, dtype=float).reshape(self._sizes[1], self.width)
        self._fed = (ctypes.c_void_p * 2)(self._carry.ctypes.data, self._feed.ctypes.data)
        self._work = np.zeros(size(ctypes.c_uint32(steps), ctypes.c_uint32(commands)))

    def __call__(self, x: Any, first: Any, base: Any, by: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the predictions ``(steps, prediction)`` and Jacobian ``(steps, prediction, steps, command)``.

        Args:
            x: the state ``(state,)`` before the first tick.
            first: its inputs ``(input,)``.
            base: ``(steps, input)``; row 0 is not read.
            by: ``(steps, command, input)``, how a command changes the inputs of its tick.

        Raises:
            ValueError: an argument has another size, or inputs are not finite or beyond their limits.
        """
        states, inputs = self._sizes
        table = self.steps * inputs
        arguments = [np.ascontiguousarray(value, dtype=float) for value in (x, first, base, by)]
        for value, size in zip(arguments, (states, inputs, table, table * int(self._shape[1])), strict=True):
            if value.size != size:
                raise ValueError(f"an argument of a horizon has {value.size} numbers; {size} are needed")
        y, jacobian = np.empty((self.steps, self.width)), np.empty((self.steps, self.width, *self._shape))
        arrays = (arguments[0], self._shape, arguments[3], arguments[1], arguments[2])
        places = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        ends = [ctypes.c_void_p(array.ctypes.data) for array in (y, jacobian, self._work)]
        refused = self._run(*places, self._fed, *ends)
        if refused:
            raise ValueError(f"inputs of tick {refused - 1} of the horizon are not finite or beyond their limits")
        return y, jacobian
