"""The live flow: frame, window, forecast."""
