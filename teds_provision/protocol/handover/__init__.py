"""What travels between base stations: bundles, receipts, revocations, and the JOSE forms around them."""
