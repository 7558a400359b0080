"""Which structure the training segments support, and whether other data confirm it."""
