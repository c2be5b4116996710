"""The page of how data cover a machine's range, and of their quality."""
