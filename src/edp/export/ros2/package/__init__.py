"""The Python of an exported package; it is copied as it stands and imports nothing of EDP."""
