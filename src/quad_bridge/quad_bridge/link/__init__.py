"""One conversation with one far end: port, clock, stamps. It knows no gains, sensors or topics."""
