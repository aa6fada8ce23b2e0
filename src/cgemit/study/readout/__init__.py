"""Studies of analog read-outs: calibration of cluster errors, and scans against the incidence."""
