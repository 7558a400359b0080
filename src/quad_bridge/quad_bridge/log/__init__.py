"""The log: bags written so that a kill at any instant costs half a second, and read again."""
