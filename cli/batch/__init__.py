"""Many files at once: a batch with one summary, and a folder that is watched."""
