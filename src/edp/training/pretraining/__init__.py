"""Training of one network over many machines: joint training and meta-learning."""
