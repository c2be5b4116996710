"""Committees trained on folds: a linear model, and learners of several kinds on what it leaves (bagging, stacking)."""
