"""Data-set stores: recordings in SI units on one grid, stored so that any segment can be read alone.

A store is a folder: ``store.json`` says what is in it, ``rows/KEY.f32`` hold the samples as dimensionless values,
float32, little end first, one recording after the other, row by row.
"""

from edp.logs.store.building import build_store
from edp.logs.store.index import INDEX, StoreIndex, is_store, read_index
from edp.logs.store.opening import check_store, read_store

__all__ = [
    "INDEX",
    "StoreIndex",
    "build_store",
    "check_store",
    "is_store",
    "read_index",
    "read_store",
]
