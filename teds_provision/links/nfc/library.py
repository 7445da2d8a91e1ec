"""nfcpy, imported once, with what its import does to the whole program undone.

Importing nfcpy 1.0.4 turns ``logging.captureWarnings`` on, sets its own logger to INFO and runs ``ldconfig`` and
``gcc`` from PATH to look for a libcrypto that only LLCP encryption would use. Import this module only where a reader
or an emulated tag is really wanted: it costs some 100 ms.
"""

from __future__ import annotations

import ctypes.util
import logging
import warnings
from typing import Any


def _load() -> Any:
    shown, find = warnings.showwarning, ctypes.util.find_library
    ctypes.util.find_library = lambda name: None  # nobody here speaks LLCP
    try:
        import nfc
        import nfc.clf.udp
        import nfc.tag.tt2
        import nfc.tag.tt4
    finally:
        ctypes.util.find_library = find
    if warnings.showwarning is not shown:
        logging.captureWarnings(False)
    wordy = logging.getLogger().getEffectiveLevel() <= logging.DEBUG
    logging.getLogger("nfc").setLevel(logging.DEBUG if wordy else logging.CRITICAL)
    return nfc


nfc: Any = _load()
UdpDevice: Any = nfc.clf.udp.Device
Type2Tag: Any = nfc.tag.tt2.Type2Tag
NfcpyType2Ndef: Any = nfc.tag.tt2.Type2Tag.NDEF
Type2TagCommandError: Any = nfc.tag.tt2.Type2TagCommandError
Type4ATag: Any = nfc.tag.tt4.Type4ATag
NfcpyType4Ndef: Any = nfc.tag.tt4.Type4Tag.NDEF
