"""Quality of recordings: checks of single recordings, comparisons of several, and measures of noise and spikes."""
