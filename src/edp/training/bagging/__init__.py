"""Ensembles trained with cross-validation folds.

A linear model, and several kinds of learners on its residuals (bagging, stacking).
"""
