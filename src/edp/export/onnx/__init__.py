"""ONNX export: a graph of a single sample with explicit states and a graph of a window, both in SI units."""

from edp.export.onnx.target import OnnxTarget

__all__ = ["OnnxTarget"]
