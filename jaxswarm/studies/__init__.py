"""Studies of many runs: grids of settings, and searches with Optuna."""
