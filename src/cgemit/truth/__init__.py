"""Links of hits and tracks to the particles that left them."""
