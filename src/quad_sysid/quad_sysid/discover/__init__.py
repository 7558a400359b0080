"""Which structure the training segments speak for, and whether other data agree."""
