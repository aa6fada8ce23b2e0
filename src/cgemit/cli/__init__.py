"""The command line: one module for each command. Results go to stdout or files, progress and log to stderr."""
