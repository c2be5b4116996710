"""Ensembles trained with cross-validation folds: a linear model, and learners of several kinds on its residuals (bagging, stacking)."""
