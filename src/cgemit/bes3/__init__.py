"""Files of the experiment BESIII: events, all their wire hits, and their tracks fitted again."""
