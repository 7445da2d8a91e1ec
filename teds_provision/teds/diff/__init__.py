"""What changes between two datasheets, in physical terms."""
