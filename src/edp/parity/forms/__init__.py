"""Forms that `edp parity` runs: a file each."""

from edp.parity.forms import c_code, matlab, onnx_runtime, ticks

__all__ = ["c_code", "matlab", "onnx_runtime", "ticks"]
