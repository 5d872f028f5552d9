"""The command line, a module for each program; `main` takes the words and returns the exit code."""
