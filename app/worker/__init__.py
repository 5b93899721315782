"""The worker process: claims jobs, keeps them, runs them in a child, ends them."""
