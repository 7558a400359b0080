"""What an operator sees during a flight: state, coverage of the band, lines. No ROS, no I/O."""
