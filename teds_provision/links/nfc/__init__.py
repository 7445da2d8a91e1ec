"""NFC: TNEP over NDEF on Type 4 and Type 2 tags, through nfcpy."""
