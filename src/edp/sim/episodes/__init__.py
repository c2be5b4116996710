"""Batched simulation of machines in one compiled call per sample: plant, sensors and observations."""
