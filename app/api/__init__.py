"""The edge: one thin router per noun, and one way to say no."""
