"""Judging a trained network: scores, rollouts, baselines and footprint."""
