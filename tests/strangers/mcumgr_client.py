"""An SMP client in Rust (mcumgr-toolkit) over UDP, in an environment of its own: ``PORT IMAGE before|after``.

Prints one JSON object: what each call gave, or the error that it met.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcumgr_toolkit


def main() -> None:
    """Update a board: ``before`` its restart, which it asks for last, or ``after`` it."""
    port, image, part = sys.argv[1:]
    client = mcumgr_toolkit.MCUmgrClient.udp("127.0.0.1", int(port), timeout_ms=60_000)
    client.set_retries(0)
    octets = Path(image).read_bytes()
    digest = mcumgr_toolkit.mcuboot_get_image_info(octets).hash
    gave: dict[str, Any] = {}

    def call(name: str, function: Callable[..., Any], *arguments: Any) -> None:
        try:
            gave[name] = function(*arguments)
        except RuntimeError as error:
            gave[name] = str(error).split()[-1]

    if part == "before":
        call("buffer", lambda: client.os_mcumgr_parameters().buf_size)
        client.use_auto_frame_size()
        call("slots", lambda: [slot.slot for slot in client.image_slot_info()[0].slots])
        call("erase the slot", client.image_erase)
        call("erase storage", client.zephyr_erase_storage)
        call("shell", client.shell_execute, ["kernel reboot"])
        call("settings", client.settings_write, "a", b"b")
        call("file", client.fs_file_upload, "/lfs/a", b"b")
        call("time", client.os_get_datetime)
        call("keep what runs", client.image_set_state, None, True)
        call("upload", client.image_upload, octets)
        call("keep what never ran", client.image_set_state, digest, True)
        call("try", lambda: [slot.version for slot in client.image_set_state(digest)])
    else:
        call("keep", lambda: [slot.version for slot in client.image_set_state(None, True)])
    call(
        "images", lambda: [[slot.slot, slot.version, slot.confirmed, slot.pending] for slot in client.image_get_state()]
    )
    if part == "before":
        call("restart", client.os_system_reset)
    print(json.dumps(gave))


if __name__ == "__main__":
    main()
