"""The node's end of BLE."""
