"""Records in, answers out: the packages of mathematics, called in one line."""
