"""The phased model search: what may be changed, what was trained, and what follows from it."""
