"""Find the tests of the gate that others make redundant, by CPU, statements and branches (make redundant)."""
