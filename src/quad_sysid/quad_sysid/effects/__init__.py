"""What the base lacks: the table of effects, and how one is chosen or none."""
