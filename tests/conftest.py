"""For all tests: hypothesis without deadlines (machines are shared), the same examples on every run of the gate.

``station`` and ``board`` are a fresh desk for each test; rooms whose stations are others have fixtures of their own.
What a whole module shares is visited by each of its tests (``SHARED``): what a test leaves there is ended after it,
however it ended, so that one failure is one failure.

At the gate (``CI`` is set), and where ``make test`` could install its packages (``TEST_PACKAGES``), a test marked
``system`` that is skipped has failed. Elsewhere the run ends with a line that counts what was not tested.
"""

from __future__ import annotations

import gc
import os
import signal
import tempfile
from collections.abc import Generator, Iterator
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from teds_provision.station.station import Station
from tests.bench import Board, copied_station
from tests.dealing import dealt
from tests.examples import limit_examples
from tests.firmware.c_node import OFFERS
from tests.nightly import REFUSED, UNNAMED, refusals
from tests.passphrase_costs import lower_costs

ROOT = Path(__file__).resolve().parents[1]
AT_THE_GATE = os.environ.get("CI", "").lower() not in ("", "0", "false")
COMPLETE = AT_THE_GATE or os.environ.get("TEST_PACKAGES") == "installed"

ALL_IN_C = os.environ.get("TEDS_NODE", "python") == "c"

OF_TERMINALS = {
    "COLUMNS",
    "LINES",
    "NO_COLOR",
    "FORCE_COLOR",
    "CLICOLOR",
    "CLICOLOR_FORCE",
    "PAGER",
    "EDITOR",
    "VISUAL",
}
OF_PROXIES = {"http_proxy", "https_proxy", "all_proxy", "no_proxy"}
OF_THE_CALLER = OF_TERMINALS | {"AMENT_PREFIX_PATH", "CYCLONEDDS_URI", "NOTIFY_SOCKET", "WATCHDOG_USEC"}
IN_MEMORY = Path("/dev/shm", f"tp{os.getuid()}")
ROOM = 8 << 30  # octets free there; a run of all tests needs less than a tenth of it
LONGEST_TEMPORARY = 20  # characters: tests bind Unix sockets below it, whose whole path has 107 at most
SHARED = ("rig", "bench", "lab")  # fixtures of a module whose value says ``visited``

# Of the checks of health that one alone is about time: examples that a busy machine was slow to make are good examples.
settings.register_profile("desk", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("quick", settings.get_profile("desk"), max_examples=10)
settings.register_profile("gate", settings.get_profile("desk"), derandomize=True)
settings.load_profile("gate" if AT_THE_GATE else "desk")

gc.set_threshold(50_000, 20, 100)  # parsing the whole package takes 3.2 s of CPU with the usual ones, 0.9 s without


def pytest_configure() -> None:
    """Take Ctrl-C and the end of a terminal as usual: in the background, or under nohup, they are ignored by all below.

    Homes and recordings lie in memory if there is room: a test waits for a disk at every durable write, for nothing.
    And what the caller's environment says of terminals, proxies, ROS and this program is nothing that a test asked for.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if "TMPDIR" not in os.environ and _in_memory_is_room():
        os.environ["TMPDIR"] = tempfile.tempdir = str(IN_MEMORY)
    if len(tempfile.gettempdir()) > LONGEST_TEMPORARY and os.access("/tmp", os.W_OK | os.X_OK):
        os.environ["TMPDIR"] = tempfile.tempdir = "/tmp"
    for name in list(os.environ):
        theirs = name in OF_THE_CALLER or name.lower() in OF_PROXIES or name.startswith(("TEDS_PROVISION_", "ROS_"))
        if theirs:
            del os.environ[name]
    lower_costs()


def _in_memory_is_room() -> bool:
    try:
        found = os.statvfs(IN_MEMORY.parent)
        IN_MEMORY.mkdir(mode=0o711, exist_ok=True)  # servers that give up root (PostgreSQL) reach theirs
    except OSError:
        return False
    runs_programs = not found.f_flag & os.ST_NOEXEC  # tests compile programs there
    return runs_programs and IN_MEMORY.stat().st_uid == os.getuid() and found.f_bavail * found.f_frsize >= ROOM


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run what is marked ``both_nodes`` with the Python node and with the one in C.

    ``both_nodes(nightly_in_c=why)``: the gate has the Python node alone. ``why`` says which tests hold the node in C.
    """
    mark = metafunc.definition.get_closest_marker("both_nodes")
    if mark is not None and not ALL_IN_C:
        in_c = [pytest.mark.system]
        if (why := mark.kwargs.get("nightly_in_c")) and not metafunc.definition.get_closest_marker("nightly"):
            in_c.append(pytest.mark.nightly(f"{metafunc.definition.nodeid} holds this with the Python node; {why}"))
        metafunc.parametrize("node_kind", ["python", pytest.param("c", marks=in_c)])


@pytest.fixture
def node_kind() -> str:
    """Return which node a desk has: ``python``, or ``c`` (``make test-c``)."""
    return "c" if ALL_IN_C else "python"


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Generator[None, None, None]:
    """Let a rule about time be held by the best of three tries, as ``best_of`` does; every try is told (``-rR``).

    Nothing but these is tried again: a rule that says nothing about time fails at once. What needs of a node what the
    one in C lacks is left out there. What is out of the gate names a test in it that holds the same rule. Workers get
    what is left in an order in which each begins with what takes long.
    """
    if not any("::" in word for word in config.args):  # files are collected whole
        config.stash[REFUSED] = refusals(items)
    timed: set[Path] = set()
    items[:] = [item for item in items if not _in_c(item) or _needed(item) <= OFFERS]
    if settings.get_current_profile_name() == "quick":
        limit_examples(items, settings().max_examples)
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=2))
            timed.add(item.path)
    config.stash[UNNAMED] = [path for path in timed if "mark.realtime" not in path.read_text(encoding="utf-8")]
    yield  # -m and -k choose
    workers = getattr(config, "workerinput", {}).get("workercount", 1)
    if workers > 1:
        items[:] = dealt(items, [item.nodeid for item in items], workers)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Leave what the collection made out of garbage collections: 300 MB of it, and none of it ends before the run."""
    gc.freeze()


def _in_c(item: pytest.Item) -> bool:
    return ALL_IN_C or (isinstance(item, pytest.Function) and _param(item, "node_kind") == "c")


def _param(item: pytest.Function, name: str) -> object:
    return item.callspec.params.get(name) if hasattr(item, "callspec") else None


def _needed(item: pytest.Item) -> set[str]:
    return {word for mark in item.iter_markers("needs") for word in mark.args}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Fail what is skipped although what it needs could be installed."""
    report = yield
    if COMPLETE and report.skipped and item.get_closest_marker("system") and not hasattr(report, "wasxfail"):
        why = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome, report.longrepr = "failed", f"skipped although its packages can be installed: {why}"
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what was not tested for want of a package; ``make test`` repeats it as its last line."""
    skipped = [
        report
        for report in terminalreporter.stats.get("skipped", [])
        if isinstance(report, pytest.TestReport) and "system" in report.keywords  # a module may be skipped, too
    ]
    if skipped and "PYTEST_XDIST_WORKER" not in os.environ:
        line = f"Not tested: {len(skipped)} tests that need Debian packages. As root: sh scripts/install-test-packages"
        terminalreporter.write_line(line)
        with suppress(OSError), (ROOT / "build" / "not-tested").open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")


@pytest.fixture(autouse=True)
def nothing_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """Put what the module shares back in order after each test that has it."""
    with ExitStack() as stack:
        for name in SHARED:
            if name in request.fixturenames:
                visited = getattr(request.getfixturevalue(name), "visited", None)
                stack.enter_context(visited() if visited is not None else nullcontext())
        yield


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    """Yield a new station with a passphrase vault at the lowest cost."""
    made = copied_station(tmp_path / "home")
    yield made
    made.close()


@pytest.fixture
def board() -> Board:
    """Return a new node in factory state."""
    return Board()
