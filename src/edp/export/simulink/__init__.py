"""Simulink and MATLAB: an S-function and a C Caller around the C code, plain MATLAB code, the window as ONNX."""

from edp.export.simulink.target import SimulinkTarget

__all__ = ["SimulinkTarget"]
