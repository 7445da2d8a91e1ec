"""A service on bad days in a row: the clock set, the disk filled, an adapter pulled, thousands of invented nodes."""
