"""Processes, files, memory limits and the table of extensions: no domain knowledge."""
