"""A client of Foxglove's WebSocket protocol that stays: it prints what appears, what goes, and decoded messages.

Usage: python foxglove_watcher.py URL [CA.pem]. A line of JSON each: {"opened": topics}, {"closed": topics},
{"parameters": {name: facts}} after each change, and the first messages of each channel as {"topic", "time", "fields"}.
It needs nothing of the package: websockets and rosbags alone.
"""

from __future__ import annotations

import json
import ssl
import struct
import sys
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect
from websockets.typing import Subprotocol

SHOWN = 3
"""Messages that are printed of each channel: of some thousands a second nobody needs more."""


def main(url: str, authority: str = "") -> None:
    """Print what comes until the server ends the connection."""
    store = get_typestore(Stores.ROS2_JAZZY)
    channels: dict[int, dict[str, Any]] = {}
    shown: dict[int, int] = {}
    tls = ssl.create_default_context(cafile=authority) if authority else None
    with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, ssl=tls) as line:
        for message in line:
            if isinstance(message, bytes):
                number, at = struct.unpack_from("<IQ", message, 1)
                channel = channels.get(number)
                shown[number] = shown.get(number, 0) + 1
                if message[0] != 1 or channel is None or shown[number] > SHOWN:
                    continue
                name = channel["schemaName"]
                if name not in store.types:
                    store.register(get_types_from_msg(channel["schema"], name))
                decoded: Any = store.deserialize_cdr(message[13:], name)
                fields = {
                    key: value.tolist() if isinstance(value, np.ndarray) else value
                    for key, value in vars(decoded).items()
                    if key not in ("stamp", "__msgtype__")
                }
                show(topic=channel["topic"], time=at, fields=fields)
                continue
            record = json.loads(message)
            if record["op"] == "advertise":
                channels |= {channel["id"]: channel for channel in record["channels"]}
                wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in record["channels"]]
                line.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                line.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "all"}))
                show(opened=[channel["topic"] for channel in record["channels"]])
            elif record["op"] == "unadvertise":
                show(closed=[channels.pop(number)["topic"] for number in record["channelIds"]])
                line.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "all"}))
            elif record["op"] == "parameterValues":
                show(
                    parameters={parameter["name"]: json.loads(parameter["value"]) for parameter in record["parameters"]}
                )
            elif record["op"] == "serverInfo":
                show(server=record["name"])


def show(**facts: Any) -> None:
    """Print a line."""
    print(json.dumps(facts), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
