"""Learning curves of run folders: statistics over seeds, plots and labels."""
