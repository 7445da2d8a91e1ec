"""The whole store of a station, sealed into one file, and back."""
