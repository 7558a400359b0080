"""Records in, answers out: the rooms of mathematics put to work in one line."""
