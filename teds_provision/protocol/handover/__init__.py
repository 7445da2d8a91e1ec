"""Bundles, receipts and revocations of a handover: their content, and how they are signed and sealed.

The modules are loaded at their first use: showing a file does not need the cryptography of a bundle.
"""
