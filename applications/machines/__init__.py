"""The user's machines: revisions, differences, checks before a job."""
