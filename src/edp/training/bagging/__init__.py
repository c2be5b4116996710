"""Ensembles trained on folds: a linear model, and several kinds of learners on its residuals (bagging, stacking)."""
