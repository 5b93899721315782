"""What becomes of people's trials, jobs and forecasts when something breaks."""
