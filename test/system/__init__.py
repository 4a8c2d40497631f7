"""Trials of a whole network: crashes, impairments, fuzzing and several hosts."""
