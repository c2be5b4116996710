"""The machinery of settings: TOML to dataclasses and back, overrides, and ranges of numbers."""
