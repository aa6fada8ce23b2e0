"""Digitizers of CGEM layers, a file each."""
