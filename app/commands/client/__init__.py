"""A client of the service's v1 interface. It imports nothing of the service."""
