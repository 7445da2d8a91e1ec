"""The base station over store and vault: identity, node keys, pins, policy."""
