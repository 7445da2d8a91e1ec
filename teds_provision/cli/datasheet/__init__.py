"""Commands about datasheets: show and profile."""
