"""The aircraft's gains: their table, the gate, the protocol, the update and its watch. No ROS."""
