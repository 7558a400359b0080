"""What the sensors of one aircraft are worth: biases at rest, compass offsets, vibration."""
