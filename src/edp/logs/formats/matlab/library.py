"""The one place where mat-io and pandas are imported: mat-io sets a pandas option that newer pandas warns about."""

from __future__ import annotations

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import matio
    import pandas
    from matio.utils import MatlabOpaque

__all__ = ["MatlabOpaque", "matio", "pandas"]
