"""The commands of `mcgicp`, one file for each or for a few related ones."""
