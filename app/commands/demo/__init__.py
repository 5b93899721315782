"""`kinecast demo`: synthetic people streamed to a service, and how well it foresees them."""
