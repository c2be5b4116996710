"""Judging: held-out scores beside baselines, and what a predictor costs."""
