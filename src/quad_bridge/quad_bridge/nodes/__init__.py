"""The nodes: parameters, topics, services and timers, wired to the rooms. No arithmetic here."""
