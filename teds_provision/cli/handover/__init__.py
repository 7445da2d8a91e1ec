"""Commands that move keys and trust between base stations."""
