"""Settings: convert TOML to dataclasses and back, apply overrides, check ranges."""
