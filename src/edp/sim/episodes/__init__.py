"""Machines under way, many in one compiled call a tick: plant, sensors and what is shown of them."""
