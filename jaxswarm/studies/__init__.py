"""Many runs: grids of settings and searches with Optuna."""
