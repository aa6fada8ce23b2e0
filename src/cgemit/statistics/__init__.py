"""Widths, pulls and chi-square of fitted tracks, and the curves and histograms of figures."""
