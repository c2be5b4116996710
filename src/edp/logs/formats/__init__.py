"""Readers and writers of log files: one format a file, registered by its name."""
