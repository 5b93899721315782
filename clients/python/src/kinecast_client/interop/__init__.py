"""Forecasts in the words of other tools: ROS 2 messages, Foxglove's schemas, MCAP files.

Everything here is plain conversion: dicts in, dicts out, without ROS and without a connection. Only
`mcap` needs a package of its own (`pip install 'kinecast-client[mcap]'`).
"""
