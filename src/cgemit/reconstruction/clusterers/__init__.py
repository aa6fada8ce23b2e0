"""Clusterers of CGEM layers, a file each."""
