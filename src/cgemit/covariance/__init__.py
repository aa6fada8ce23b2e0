"""Resolutions without events: the covariance of a track's helix, and its exact split by cause.

The compiled stage ``covariance/`` traces a track from the origin with the fit's own kernels, expects a hit wherever the
track crosses a readout, and runs the filter (docs/methods/analytic.md).
"""
