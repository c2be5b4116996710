"""Commands over many machines: their work in units for a pool or a cluster, and models and reports of a fleet."""
