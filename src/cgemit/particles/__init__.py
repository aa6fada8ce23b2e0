"""Particles that start an event: species, guns, tables, samples."""
