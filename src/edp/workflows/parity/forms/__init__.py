"""Forms that `edp verify` runs: a file each."""

from edp.workflows.parity.forms import c_code, casadi, fmu, matlab, onnx_runtime, ros2, ticks

__all__ = ["c_code", "casadi", "fmu", "matlab", "onnx_runtime", "ros2", "ticks"]
