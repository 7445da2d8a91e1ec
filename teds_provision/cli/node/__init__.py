"""The commands that identify, key, write and check one node or many."""
