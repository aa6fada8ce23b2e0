"""The command line: one module for each sub-command; results to stdout or files, progress and log to stderr."""
