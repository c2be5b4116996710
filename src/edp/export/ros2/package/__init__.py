"""Python code of an exported package; it is copied unchanged and does not import EDP."""
