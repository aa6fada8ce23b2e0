"""Constants of a detector from tracks, and what they will reach (docs/methods/alignment.md)."""
