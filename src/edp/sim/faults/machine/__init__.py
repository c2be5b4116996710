"""Machine faults, one module per fault type."""
