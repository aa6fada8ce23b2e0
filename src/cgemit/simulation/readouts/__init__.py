"""Read-outs of CGEM layers, a file each."""
