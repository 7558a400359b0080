"""The gains that flew: their history, as the bridge keeps it, and the way back to a set."""
