"""What is wrong with recordings: checks of one, comparisons of several, and measures of noise and spikes."""
