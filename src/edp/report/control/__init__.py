"""The page of closed loops."""
