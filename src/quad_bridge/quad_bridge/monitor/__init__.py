"""The operator's view of a flight: state, coverage of the band, lines. No ROS, no I/O."""
