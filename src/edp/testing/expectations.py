"""Reporting of broken contracts, independent of test runners."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor


class ContractError(AssertionError):
    """Part that violates a contract of EDP; test runners count it as a failure."""


def expect(condition: bool, message: str) -> None:
    """Go on where the condition holds.

    Raises:
        ContractError: it does not; `message` says what is wrong.
    """
    if not condition:
        raise ContractError(message)


def expect_near(
    actual: Tensor | ArrayLike, expected: Tensor | ArrayLike, message: str, rtol: float, atol: float
) -> None:
    """Go on where two arrays are equal within a tolerance; NaN equals NaN.

    Raises:
        ContractError: they are not; `message` says what is wrong, and the largest difference follows.
    """
    first, second = (_array(values) for values in (actual, expected))
    expect(first.shape == second.shape, f"{message}: shapes {first.shape} and {second.shape}")
    # NaN on both sides is agreement: both say that there is no value.
    near = np.isclose(first, second, rtol=rtol, atol=atol, equal_nan=True)
    if not near.all():
        largest = float(np.nanmax(np.abs(first - second)))
        raise ContractError(f"{message}: {int((~near).sum())} of {near.size} numbers differ, by up to {largest:.3g}")


def _array(values: Tensor | ArrayLike) -> np.ndarray:
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    # Double precision, so that the comparison itself does not round.
    return np.asarray(values, dtype=np.float64)
