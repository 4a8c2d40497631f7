"""Tests of the network's invariants under crashes, an impaired channel and malformed messages."""
