"""The host around the compiled program: chunks of updates, devices, files, progress and checkpoints."""
