"""Model of sensors, filters and buses: logged signals from the plant state."""
