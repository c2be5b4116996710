"""What the machine's sensors, filters and buses make of the state."""
