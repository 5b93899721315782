"""Plain values and rules of the service: no input or output, no torch, no SQL."""
