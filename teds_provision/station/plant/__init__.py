"""The rows of a station about its plant and its production line: one class for each topic."""
