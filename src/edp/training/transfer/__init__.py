"""Training of a network with data of two machines: strategies, centring, and checks of the data."""
