"""The daemon: begins everything in order, and ends it in order."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, get_args

from teds_provision import __version__
from teds_provision.errors import NotFound, UsageFailure
from teds_provision.ncap.live import Live
from teds_provision.ncap.roster import Roster
from teds_provision.ncap.settings import Detection, Settings
from teds_provision.ncap.tokens import Tokens
from teds_provision.ncap.turns import Turns
from teds_provision.ncap.watching import Watch
from teds_provision.station.station import Station
from teds_provision.talk.conversation import Conversation

_LOOK: Final = 1.0
"""Seconds between two looks whether another process has changed the store."""
_ENDING: Final = 8.0
_DISCOVERY: Final = 1.5


class Daemon:
    """All that runs, over one station; what the API calls."""

    def __init__(self, station: Station, settings: Settings) -> None:
        self.station, self.settings = station, settings
        self.live = Live()
        self.turns = Turns()
        self.tokens = Tokens(station.home)
        self.roster = Roster(station, self.live, lambda uuid, number: "")
        self.detection: Detection = settings.detection or "whitelist"
        self.url: str | None = None
        self.started = time.time()
        self._version = station.version()
        self._stop = threading.Event()
        self.watches = [
            Watch(place, station, self.roster, self.live, self.turns, self, lambda: self.detection == "transparent")
            for place in settings.places
        ]
        self._observer = threading.Thread(target=self._observe, name="store", daemon=True)

    # -- its life ----------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Links, measurements and the eye on the store, for the length of the block; then all let go, in order."""
        self.roster.refresh()
        self._observer.start()
        for watch in self.watches:
            watch.start()
        try:
            yield
        finally:
            self._stop.set()
            for watch in self.watches:
                watch.stop()
            until = time.monotonic() + _ENDING
            for watch in self.watches:
                watch.join(max(0.1, until - time.monotonic()))
            self._observer.join(_LOOK)

    async def serve(self, begin: Callable[[], Any], stop: asyncio.Event) -> None:
        """Fan out what is live until ``stop``; ``begin`` is awaited once the loop runs."""
        fan = asyncio.create_task(self.live.run())
        try:
            await begin()
            await stop.wait()
        finally:
            fan.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await fan

    def _observe(self) -> None:
        """What the command line does beside us is seen within a second."""
        while not self._stop.wait(_LOOK):
            version = self.station.version()
            if version != self._version:
                self._version = version
                self.roster.refresh()
                self.live.event("store", state="changed")

    # -- what the API asks -------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """api.md, `/status`."""
        return {
            "version": __version__,
            "station": {"name": self.station.name, "fingerprint": self.station.fingerprint},
            "started": self.started,
            "time": time.time(),
            "url": self.url,
            "detection": self.detection,
            "links": [self._link(watch) for watch in self.watches],
            "nodes": sum(self.roster.present(watch.place) for watch in self.watches),
            "clients": self.live.listeners,
        }

    def _link(self, watch: Watch) -> dict[str, Any]:
        state = watch.state
        return {
            "place": watch.place,
            "via": watch.place.partition(":")[0],
            "state": state.state,
            "problem": state.problem,
            "waiting": state.waiting or None,
            "since": state.since,
            "nodes": self.roster.present(watch.place),
            "strangers": self.roster.strangers(watch.place),
        }

    def hello(self) -> dict[str, Any]:
        """The first message of /live."""
        return {"type": "hello", "version": __version__, "station": self.station.name, "time": time.time()}

    def set_detection(self, mode: str) -> None:
        """Change the mode, and look at all links anew; raises UsageFailure."""
        if mode not in get_args(Detection):
            raise UsageFailure(f"{mode!r} is no mode of detection.", hint="Use transparent or whitelist.")
        self.detection = mode  # type: ignore[assignment]
        self.station.audit("detection", None, "set", mode=mode)
        self.live.event("detection", state=mode)
        for watch in self.watches:
            self.roster.forget_place(watch.place)
            watch.look_at_all()

    def discover(self) -> list[dict[str, Any]]:
        """Ask every link now, and give the nodes after a moment."""
        for watch in self.watches:
            watch.look_at_all()
        self._stop.wait(_DISCOVERY)
        return self.roster.nodes()

    def resolve(self, text: str) -> str:
        """The UUID that a path names: whole, or a prefix or name as everywhere; raises NotFound, UsageFailure."""
        digits = text.lower().removeprefix("0x")
        if self.roster.known(digits):
            return digits
        try:
            return self.station.nodes.resolve(text).hex()
        except NotFound:
            near = [uuid for uuid in self.roster.uuids() if uuid.startswith(digits)] if len(digits) >= 4 else []
            if len(near) == 1:
                return near[0]
            raise

    def login_url(self, *, read_only: bool = False) -> str:
        """The page's address with a token that works once; raises UsageFailure where no page is served."""
        if self.url is None:
            raise UsageFailure("The page is not served.", hint="Start it with --http: ncap run --http 127.0.0.1:8351")
        return f"{self.url}/login?token={self.tokens.login_link(read_only=read_only)}"

    # -- nodes that come ---------------------------------------------------------------------------------------------

    def serve_node(self, node: Conversation) -> bool:
        """Whether somebody asked for this node and it was done."""
        return False
