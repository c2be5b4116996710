"""Watching a machine: residuals in, alarms out, with a false-alarm rate that was measured on healthy sessions."""
