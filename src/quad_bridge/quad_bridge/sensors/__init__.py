"""The gyro's bias of an aircraft at rest: from a bag, and live before each flight."""
