"""The commands of the station itself: identity, trust, settings, vault, handover, backup, log."""
