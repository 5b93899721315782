"""Does forecasting pay for a robot that works beside a person, and does a personal version?"""
