"""ONNX: one graph of a tick with explicit states, and one of a whole window, both from SI units to SI units."""

from edp.export.onnx.target import OnnxTarget

__all__ = ["OnnxTarget"]
