"""A run on disk: its folder, metrics, checkpoints and result, and how it stops and resumes."""
