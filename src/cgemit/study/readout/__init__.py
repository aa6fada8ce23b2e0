"""What an analog read-out resolves: calibration of its cluster errors, and scans against the incidence."""
