"""One file a foreign format: read and write, nothing else."""
