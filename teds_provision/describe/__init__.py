"""Datasheets in formats that other tools read: a W3C Thing Description, ros2_control, an Asset Administration Shell."""
