"""The sensors of one aircraft: biases at rest, compass offsets, vibration."""
