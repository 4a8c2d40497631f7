"""Tests of the commands, which share a running network."""
