"""The commands that measure, record, calibrate and drive."""
