"""Logs of other flight controllers → bags of the contract: PX4, ArduPilot, Betaflight."""
