"""Data preparation: features, scaling, splits and chunks for training."""
