"""A simulation in a process of its own: python simulation_client.py URL TOKEN; lines in, the station's answers out.

It needs nothing of the package: websockets alone.
"""

import sys
import threading

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

with connect(sys.argv[1], additional_headers={"Authorization": f"Bearer {sys.argv[2]}"}) as socket:

    def answers() -> None:
        try:
            for message in socket:
                print(message, flush=True)
        except ConnectionClosed as closed:
            print(closed, flush=True)

    threading.Thread(target=answers, daemon=True).start()
    for line in sys.stdin:
        socket.send(line)
