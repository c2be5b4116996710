"""Forms that `edp parity` runs: a file each."""

from edp.parity.forms import c_code, onnx_runtime, ticks

__all__ = ["c_code", "onnx_runtime", "ticks"]
