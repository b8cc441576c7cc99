"""Initial guesses: paths through free space and among obstacles, and the variables of a motion along them."""
