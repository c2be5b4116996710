"""FMUs as plants: a checked archive, a checked description, an instance of its library, and the environment around."""
