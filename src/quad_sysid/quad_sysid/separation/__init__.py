"""Which flight separates two rival effects: simulated closed-loop flights, ranked."""
