"""Rigs that try a whole network: faults, fuzzing and several hosts."""
