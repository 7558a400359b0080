"""History of the gains, as the bridge stores it, and the return to an earlier set."""
