"""Which flight tells two rival effects apart: simulated closed-loop flights, ranked by that."""
