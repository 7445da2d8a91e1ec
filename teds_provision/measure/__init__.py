"""From datasheet to measurement: sessions, streams, clocks, groups, and the sinks that take calibrated values."""
