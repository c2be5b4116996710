"""A signal map proposed for logs that nobody described: which column is what, and how sure that is."""
