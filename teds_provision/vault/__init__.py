"""Stores of a station's secrets: the OS keyring, a PKCS #11 token, or a passphrase file."""
