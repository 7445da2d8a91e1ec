"""One node, plain or sealed: conversation, sessions, meeting, watching."""
