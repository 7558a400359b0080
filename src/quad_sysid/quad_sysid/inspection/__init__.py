"""What a bag holds and what it can be used for, before anything is fitted."""
