"""The station's end of Bluetooth LE, on bleak."""
