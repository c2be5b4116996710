"""Selection of channels by trainings with and without them."""
