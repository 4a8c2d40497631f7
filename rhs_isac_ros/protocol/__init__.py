"""The position-then-transmit protocol, without any input or output of its own."""
