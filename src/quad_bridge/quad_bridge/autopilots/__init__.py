"""Aircraft with PX4 or ArduPilot: their gains, what excites them, their logs. No ROS, no port."""
