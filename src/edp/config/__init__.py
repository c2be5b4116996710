"""The experiment's settings as a typed tree, and the presets that ship with EDP."""
