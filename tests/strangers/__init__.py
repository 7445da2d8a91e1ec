"""A node and a station that share nothing with the product: written from the contract's pages alone."""
