"""A run on disk: folder, checkpoints, metrics, the loop of chunks."""
