"""The page of a monitor's run: alarms, their evidence, and what they could be."""
