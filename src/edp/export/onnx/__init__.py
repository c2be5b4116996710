"""ONNX export: one graph of a single sample with explicit states, one of a whole window; both in SI units."""

from edp.export.onnx.target import OnnxTarget

__all__ = ["OnnxTarget"]
