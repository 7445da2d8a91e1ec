"""Measurements as the station keeps them, begun, carried on after a restart, and ended."""
