"""How an aircraft is built, measured and written to its firmware: the wizard `setup`."""
