"""A run's life on disk: its folder, metrics, checkpoints, result, interruption and resuming."""
