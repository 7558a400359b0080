"""The conversation with one aircraft: port, clock, stamps; no gains, sensors or topics."""
