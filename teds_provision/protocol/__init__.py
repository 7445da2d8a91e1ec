"""Command frames, key agreement, sessions, bundles: pure state machines of both roles, no I/O."""
