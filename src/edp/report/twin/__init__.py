"""Plots of the free runs of a twin."""
