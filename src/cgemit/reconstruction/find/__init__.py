"""Track finding from the hits alone (docs/methods/find.md)."""
