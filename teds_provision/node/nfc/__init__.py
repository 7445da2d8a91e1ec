"""The node's end of a reader: an emulated tag and the node's half of TNEP."""
