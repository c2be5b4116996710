"""From recordings to what a network is trained on: features, scaling, splits, chunks."""
