"""Trying the promises of the network: crashes, a bad air, hostile messages."""
