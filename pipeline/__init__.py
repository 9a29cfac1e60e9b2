"""The pipeline: a file in, runs, a file and its figures out; without web framework or database."""
