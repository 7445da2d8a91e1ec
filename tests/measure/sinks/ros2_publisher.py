"""Publishes one Float64 a hundred times a second on a ROS 2 topic, until it is ended: DOMAIN TOPIC VALUE."""

from __future__ import annotations

import sys
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from teds_provision.measure.sinks.ros.ros2 import THIS_MACHINE
from teds_provision.measure.sinks.ros.ros2_types import Float64


def main(domain: int, topic: str, value: float) -> None:
    """As a controller of somebody else would: best effort, newest only."""
    configured = Domain(domain, THIS_MACHINE)
    participant = DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
    qos = Qos(Policy.Reliability.BestEffort, Policy.DataRepresentation(use_cdrv0_representation=True))
    writer = DataWriter(participant, Topic(participant, f"rt{topic}", Float64), qos=qos)
    while configured:
        writer.write(Float64(value))
        time.sleep(0.01)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
