"""`kinecast bench`: how fast the service is, measured as a robot would feel it."""
