"""Every measured table and picture of the documentation (`python -m pages`)."""
