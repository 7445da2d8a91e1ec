"""Keys from one base station to another, and whom this one trusts."""
