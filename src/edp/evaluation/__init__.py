"""Evaluation: scores on held-out recordings compared with baselines, and the cost of a predictor."""
