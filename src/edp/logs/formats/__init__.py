"""Readers and writers of log files: one module per format, registered by name."""
