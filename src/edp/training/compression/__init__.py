"""Algorithms that make a network smaller: distillation, pruning, quantisation-aware training, INT8 arithmetic."""
