"""Station processes for the tests: ``hold`` (a reader that is killed), ``wait`` (Ctrl-C), ``stock`` (plain nfcpy)."""

from __future__ import annotations

import sys
import time

from teds_provision.links import LinkSettings, Notice, open_port


def hold(path: str) -> None:
    port = open_port(LinkSettings(nfc=path))
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    contact.link.exchange(bytes(10))
    print("holding", flush=True)
    time.sleep(60)


def wait(path: str) -> None:
    def report(notice: Notice) -> None:
        print(notice.kind, flush=True)

    port = open_port(LinkSettings(nfc=path))
    try:
        port.find(lambda identity: True, seconds=60, notice=report)
    except KeyboardInterrupt:
        port.close()
        sys.exit(130)


def stock(path: str) -> None:
    """What a phone or any other reader sees: nfcpy and ndeflib as they are."""
    import nfc

    with nfc.ContactlessFrontend(path) as clf:
        target = None
        while target is None:
            target = clf.sense(nfc.clf.RemoteTarget("106A"))
        tag = nfc.tag.activate(clf, target)
        for record in tag.ndef.records:
            print("record", record.type, bytes(record.data).hex(), flush=True)
        print("tag", tag.type, tag.ndef.capacity, flush=True)


if __name__ == "__main__":
    {"hold": hold, "wait": wait, "stock": stock}[sys.argv[1].split()[0]](sys.argv[1].split()[1])
