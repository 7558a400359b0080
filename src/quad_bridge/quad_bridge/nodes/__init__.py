"""The nodes: parameters, topics, services and timers, wired to pure calls. No arithmetic here."""
