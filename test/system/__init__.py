"""Rigs that test a whole network: crashes, impairments, fuzzing and several hosts."""
