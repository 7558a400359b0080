"""The log: bags in which a kill at any time costs half a second, and their reading."""
