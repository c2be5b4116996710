"""The page of a compression."""
