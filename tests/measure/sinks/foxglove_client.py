"""A client of Foxglove's WebSocket protocol: subscribes to all channels, decodes so many messages, prints them.

Usage: python foxglove_client.py PORT MESSAGES CHANNELS. It needs nothing of the package: websockets and rosbags alone.
"""

from __future__ import annotations

import json
import struct
import sys
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PROTOCOL = Subprotocol("foxglove.sdk.v1")


def plain(value: Any) -> Any:
    """Return a decoded field as JSON takes it."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def main(port: int, wanted: int, expected: int) -> None:
    """Print a line once subscribed to so many channels, then one with what was received."""
    store = get_typestore(Stores.ROS2_JAZZY)
    channels: dict[int, dict[str, Any]] = {}
    found: dict[str, list[dict[str, Any]]] = {}
    known = set(store.types)
    parameters: dict[str, dict[str, Any]] = {}
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], max_size=None) as line:
        line.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": "parameters"}))
        line.send(
            json.dumps({"op": "setParameters", "parameters": [{"name": "/bench/arm/angle", "value": "x"}], "id": "set"})
        )
        count = 0
        while count < wanted or not {"parameters", "set"} <= parameters.keys() or "/bench/arm/teds" not in found:
            message = line.recv(timeout=20)
            if isinstance(message, str):
                record = json.loads(message)
                if record["op"] == "advertise":
                    new = [channel for channel in record["channels"] if channel["id"] not in channels]
                    channels |= {channel["id"]: channel for channel in new}
                    line.send(
                        json.dumps(
                            {
                                "op": "subscribe",
                                "subscriptions": [
                                    {"id": advertised["id"], "channelId": advertised["id"]} for advertised in new
                                ],
                            }
                        )
                    )
                    # Its answer comes after the subscription was taken: requests of a connection are served in order.
                    line.send(json.dumps({"op": "getParameters", "parameterNames": [], "id": f"ready {len(channels)}"}))
                elif record["op"] == "parameterValues":
                    if record.get("id") == f"ready {expected}":
                        print(json.dumps({"subscribed": True}), flush=True)
                        continue
                    parameters[record.get("id", "")] = {
                        parameter["name"]: parameter["value"] for parameter in record["parameters"]
                    }
                continue
            if message[0] != 1:
                continue
            number, at = struct.unpack_from("<IQ", message, 1)
            channel = channels[number]
            name = channel["schemaName"]
            if name not in known:
                store.register(get_types_from_msg(channel["schema"], name))
                known.add(name)
            decoded: Any = store.deserialize_cdr(message[13:], name)
            fields = {
                key: plain(getattr(decoded, key))
                for key in decoded.__dataclass_fields__
                if key not in ("stamp", "__msgtype__")
            }
            if not channel["topic"].endswith("/teds"):
                count += 1
            found.setdefault(channel["topic"], []).append({"time": at, **fields})
    topics = [channel["topic"] for channel in channels.values()]
    print(
        json.dumps(
            {"messages": found, "channels": topics, "parameters": parameters["parameters"], "set": parameters["set"]}
        )
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:4]))
