"""An executor that hands on what the test writes into STANDIN_COMMANDS: a topic and a number a line."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

from std_msgs.msg import Float64


class SingleThreadedExecutor:
    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._stop = threading.Event()

    def add_node(self, node: Any) -> None:
        self._nodes.append(node)

    def spin(self) -> None:
        done = 0
        commands = Path(os.environ["STANDIN_COMMANDS"])
        while not self._stop.wait(0.02):
            lines = commands.read_text().splitlines() if commands.exists() else []
            for line in lines[done:]:
                topic, _, value = line.partition(" ")
                for node in self._nodes:
                    node.from_outside()
                    for _, name, callback in node.subscriptions_:
                        if name == topic:
                            callback(Float64(data=float(value)))
            done = len(lines)

    def shutdown(self, timeout_sec: float) -> bool:
        self._stop.set()
        return timeout_sec > 0
