"""Plays a CANopen sensor in a process of its own: python-canopen's LocalNode on a python-can bus.

``GROUP PORT EDS NODE-ID``. A line of stdin is a JSON object: ``{"torque": raw, "temperature": x}`` sets the objects
(the torque is sent in a PDO every 50 ms, the temperature is read by SDO), ``{"silent": true}`` ends the PDOs.
"""

from __future__ import annotations

import json
import sys

import can
import canopen


def main() -> None:
    group, port, eds, number = sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4])
    network = canopen.Network(
        can.Bus(interface="udp_multicast", channel=group, port=port, hop_limit=0, fd=False)
    ).connect()
    node = network.create_node(number, eds)
    node.sdo[0x6000][1].raw = 0
    node.sdo[0x6000][2].raw = 20.0
    node.tpdo.read(from_od=True)
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        record = json.loads(line)
        node.tpdo[1].stop()
        if "temperature" in record:
            node.sdo[0x6000][2].raw = record["temperature"]
        if "torque" in record:
            node.sdo[0x6000][1].raw = record["torque"]
            node.tpdo[1][0].raw = record["torque"]
        if not record.get("silent"):
            node.tpdo[1].start(0.05)
        print(json.dumps({"done": True}), flush=True)


if __name__ == "__main__":
    main()
