"""Measures of tables: widths, resolutions, pulls, efficiencies, and the curves of figures."""
