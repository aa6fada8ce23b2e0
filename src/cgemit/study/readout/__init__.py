"""Studies of analog read-outs: factors of cluster errors, and scans against the incidence."""
