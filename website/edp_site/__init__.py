"""Pages of the documentation site, from docs/ and from the code, and their checks; runs without the builder."""
