"""Benchmarks: provisioning end to end, the codec, handovers, many nodes; run by the bench targets of make."""
