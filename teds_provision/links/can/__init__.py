"""CAN: ISO-TP with normal fixed addressing, through python-can and can-isotp."""
