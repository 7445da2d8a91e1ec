"""The station's memory in one SQLite file: whitelist, nodes, wrapped keys, trust and the audit log."""
