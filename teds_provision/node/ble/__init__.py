"""The node's end of BLE: a peripheral on bumble."""
