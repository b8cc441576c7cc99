"""A cache, signals and lazy imports; independent of vehicles."""
