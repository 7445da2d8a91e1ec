"""Units as the standard writes them, and as people do."""
