"""Each command at a node as one call: a meeting with it, and the steps that the command is made of."""
