"""Bytes of the program of a model on a Cortex-M4F, from the statements of its C code and the functions that it calls.

What each function of the runtime takes, with all that it needs, is measured (``kernels.toml``); the model's own code is
counted from its calls and their arguments, with bytes for each that were fitted to compiled networks. Both come from
``python benchmarks/program_bytes.py --fit``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib import resources

FIXED = ("edp_valid", "edp_all_finite", "edp_copy", "edp_fill", "edp_crc")
"""Functions that every model calls."""
IN_REGISTERS = 4
"""Number of arguments of a call that are passed in registers. The remaining arguments are passed on the stack."""
CALL = re.compile(r"\b(edp_\w+)\(([^()]*)\)")
FLOAT = re.compile(r"-?[0-9.][0-9.e+-]*f")
# A linear fit; docs/journal has its error, 1.3 % at most over 187 networks.
OWN, EACH_CALL, ON_STACK, WIDE = 593.0, 14.6, 5.4, 9.7
"""Bytes of Thumb-2 code (GCC 12, -O2): constant part, per call, per stack argument, per number above 255."""
MAX_COPIED = 64
"""Maximum size in bytes of a struct that the compiler copies inline. Larger structs are copied by ``memcpy``."""


def features(statements: Iterable[str]) -> tuple[int, int, int]:
    """Return the features that determine the size of a model's own code.

    Returns:
        Calls, arguments on the stack, integers that are wider than a byte.
    """
    calls = on_stack = wide = 0
    for _, inside in CALL.findall(" ".join(statements)):
        arguments = [argument.strip() for argument in inside.split(",")]
        others = [
            argument for argument in arguments if not FLOAT.fullmatch(argument)
        ]  # floats have registers of their own
        calls += 1
        on_stack += max(0, len(others) - IN_REGISTERS)
        # Immediates above 255 take a second instruction in Thumb-2.
        wide += sum(argument.rstrip("u").isdigit() and int(argument.rstrip("u")) > 255 for argument in others)
    return calls, on_stack, wide


def own_bytes(statements: Iterable[str]) -> int:
    """Code of ``NAME.c``: `statements` are those that compute a tick and those that clear the memory."""
    calls, on_stack, wide = features(statements)
    return round(OWN + EACH_CALL * calls + ON_STACK * on_stack + WIDE * wide)


def called(statements: Iterable[str]) -> set[str]:
    """Return the functions of the runtime that statements call."""
    return {name for name, _ in CALL.findall(" ".join(statements))}


def runtime_bytes(functions: Iterable[str]) -> int:
    """Return the bytes of the runtime functions, with the functions, tables and C library parts that they call."""
    sizes, needs = _read_measurements()
    # A set: functions share what they need, and the linker takes it once.
    every = {symbol for function in functions for symbol in needs[function]}
    return sum(sizes[symbol] for symbol in every)


@cache
def _read_measurements() -> tuple[dict[str, int], dict[str, list[str]]]:
    text = resources.files("edp.export.c").joinpath("kernels.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    return table["bytes"], table["needs"]
