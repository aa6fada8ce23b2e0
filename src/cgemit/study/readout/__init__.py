"""Studies of analog readouts: factors of cluster errors, and scans against the incidence."""
