"""The command line: modules with the sub-commands; results to stdout or files, progress and log to stderr."""
