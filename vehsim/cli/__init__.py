"""The command line: reads arguments, calls the other rooms, prints, and returns an exit code."""
