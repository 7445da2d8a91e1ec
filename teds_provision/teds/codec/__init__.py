"""Octets to values and back: framing, tuples, field tables of both editions, the Security TEDS."""
