"""The fast path: what serves many people at once, with the same results as one at a time."""
