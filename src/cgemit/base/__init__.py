"""Errors, settings, files, progress and instruction sets: what has no physics."""
