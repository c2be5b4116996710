"""Phased model search: variable settings, trainings, and decisions."""
