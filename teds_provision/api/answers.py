"""Answers of the API: each class is a schema of the description, under the same name.

Values are in the SI unit of the datasheet, times in unix seconds unless they are texts. More members may come.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from teds_provision.api.bodies import Mode
from teds_provision.shapes.measurement import MeasurementSettings
from teds_provision.shapes.metadata import Meta
from teds_provision.shapes.problem import Problem
from teds_provision.shapes.verdict import CheckMembers, OriginMember, VerdictMembers

Uuid = Annotated[str, Meta(pattern="^[0-9a-f]{20}$", description="20 hex digits")]
Time = Annotated[float, Meta(description="unix seconds")]
_FirmwareOrigin = TypedDict("_FirmwareOrigin", {"from": Literal["session", "plain"]})
_UpdateFrom = TypedDict("_UpdateFrom", {"from": Annotated[str, Meta(description="the version before")] | None})


class Shown(TypedDict):
    """The unit for people: SI value × factor + offset."""

    unit: str
    factor: float | None
    offset: float | None


class Last(TypedDict):
    """The newest value of a channel."""

    value: float | None
    valid: bool
    time: Time
    age: float
    raw: NotRequired[Any]


class ActuatorState(TypedDict):
    """The last set point of an actuator."""

    value: float | None
    unit: str | None
    safe: bool | None


class Channel(TypedDict):
    """A TransducerChannel."""

    number: int
    name: str
    kind: Literal["sensor", "actuator", "event sensor"] | None
    unit: Annotated[str, Meta(description="SI unit of every number here")]
    shown: Shown
    low: float | None
    high: float | None
    uncertainty: float | None
    rate: Annotated[float, Meta(description="samples a second that the datasheet allows")] | None
    calibrated: str | None
    due: str | None
    overdue: bool
    problem: Annotated[str, Meta(description="why it gives no values")] | None
    topic: str | None
    last: Last | None
    actuator: ActuatorState | None


class PastSegment(TypedDict):
    """A stretch in which the values of a channel have one meaning: one unit, one calibration, one zero."""

    id: Annotated[int, Meta(description="ascending; a channel keeps its numbers until the station is restarted")]
    unit: Annotated[str, Meta(description="SI unit of its values; empty for counts")]
    raw: NotRequired[Annotated[bool, Meta(description="raw numbers: the channel has no calibration")]]


class Past(TypedDict):
    """The last hour of a channel, thinned; a bin in which nothing happened is left out."""

    uuid: Uuid
    channel: int
    rate: Annotated[float, Meta(description="samples a second that come now")] | None
    since: Time
    until: Time
    bin: Annotated[float, Meta(description="width of a bin in seconds")]
    time: Annotated[list[float], Meta(description="when each bin begins, unix seconds")]
    low: Annotated[list[float | None], Meta(description="least valid value of the bin, SI")]
    high: Annotated[list[float | None], Meta(description="greatest valid value of the bin, SI")]
    count: Annotated[list[int], Meta(description="samples that came")]
    invalid: list[int]
    lost: list[int]
    segment: Annotated[list[int], Meta(description="id of the segment that the bin is in")]
    segments: Annotated[list[PastSegment], Meta(description="a new one begins after a recalibration, zero or retype")]


class Invalid(TypedDict):
    """Samples of a channel that are not valid, by reason."""

    channel: int
    why: str
    count: int


class Report(TypedDict):
    """How a node does in a measurement."""

    uuid: Uuid
    state: Literal["waiting", "running", "lost", "refused", "ended"]
    why: str
    samples: NotRequired[int]
    lost: NotRequired[int]
    late: NotRequired[int]
    bad: NotRequired[int]
    invalid: NotRequired[int]
    invalid_why: NotRequired[list[Invalid]]
    clock_error: NotRequired[Annotated[float, Meta(description="seconds")] | None]


class Wrapped(TypedDict):
    """The sensor that a node wraps; its own proof ends at the wrapper."""

    kind: Literal["dbc", "eds", "iio"]
    name: str
    sha256: str | None


class Firmware(_FirmwareOrigin):
    """Firmware as a node reports it, and whether its type accepts it. A report proves no image."""

    text: Annotated[str, Meta(description="board and application")] | None
    version: Annotated[str, Meta(description="null: it does not report its firmware")] | None
    build: int | None
    image: Annotated[str, Meta(description="digest of the running image, 64 hex digits")] | None
    state: Literal["not-reported", "bad", "other", "outdated", "on-trial", "pending", "good", "unjudged"]
    changed: Annotated[bool, Meta(description="another image than when its datasheet was last signed")]


class Node(TypedDict):
    """A node, as far as it is known."""

    uuid: Uuid
    name: str | None
    profile: NotRequired[str | None]
    link: str | None
    via: str | None
    address: NotRequired[int | None]
    present: bool
    last_seen: NotRequired[str | None]
    tapped: NotRequired[float | None]
    state: str | None
    mode: NotRequired[Literal["idle", "measuring"] | None]
    whitelisted: bool
    virtual: bool
    wrapped: Wrapped | None
    unverified: Annotated[
        bool, Meta(description="name, channels and values are its own claims; its datasheet is unsigned")
    ]
    fingerprint: NotRequired[str | None]
    epoch: NotRequired[int]
    sequence: NotRequired[int]
    due: NotRequired[str | None]
    verdict: VerdictMembers | None
    heard: VerdictMembers | None
    verified: NotRequired[str | None]
    retired: NotRequired[str | None]
    problem: Problem | None
    busy: NotRequired[str | None]
    group: NotRequired[str | None]
    groups: list[str]
    measurement: str | None
    measuring: NotRequired[Report | None]
    power: dict[str, Any] | None
    firmware: Firmware | None
    channels: list[Channel]


class Located(TypedDict):
    """A node that blinks or beeps."""

    uuid: Uuid
    seconds: Annotated[int, Meta(description="0: it stopped")]


class Group(TypedDict):
    """A measurement group."""

    name: str
    uuids: list[Uuid]
    measuring: bool


class Process(TypedDict):
    """The process of a command."""

    id: int
    started: Annotated[int, Meta(description="unix seconds")]


class Measurement(MeasurementSettings):
    """A measurement, kept until it is deleted."""

    id: str
    uuids: list[Uuid]
    created: NotRequired[str]
    owner: Annotated[str, Meta(description="ncap, page, api:TOKEN, or command: a measure command of this home")]
    process: Annotated[Process | None, Meta(description="of a command; it ends with its process")]
    state: Literal["starting", "waiting", "running", "failed", "ended"]
    why: str
    lower_rate: Annotated[float | None, Meta(description="Hz to try if it loses values; null if it loses none")]
    nodes: list[Report]
    files: list[str]


class RateProposal(TypedDict):
    """The rate that bus, budget and machine can carry."""

    rate: Annotated[float, Meta(description="Hz, for every channel")]
    stated: Annotated[float, Meta(description="Hz of the fastest channel by its datasheet")]
    limit: Annotated[Literal["datasheet", "bus", "budget", "machine"], Meta(description="what makes it slower")]
    why: str


class Rate(TypedDict):
    """A proposal; null if no datasheet of the nodes states a rate."""

    proposal: RateProposal | None


class Sink(TypedDict):
    """A destination of values, with its counters."""

    measurement: str
    name: str
    state: str
    detail: NotRequired[str]
    error: str
    hint: str
    written: int
    dropped: int
    octets: NotRequired[int]
    messages: NotRequired[int]
    recorder: NotRequired[bool]
    files: NotRequired[list[str]]


class Link(TypedDict):
    """A link of the station."""

    place: str
    via: str
    virtual: NotRequired[bool]
    state: Literal["opening", "up", "down", "lent"]
    problem: Problem | None
    waiting: NotRequired[str | None]
    notice: NotRequired[
        Annotated[str, Meta(description="the newest: another station under our address, an address used twice")] | None
    ]
    since: NotRequired[Time]
    nodes: int
    strangers: int


class StationName(TypedDict):
    """Which station this is."""

    name: str
    fingerprint: str


class Budget(TypedDict):
    """Messages a second to ROS and MQTT."""

    used: float
    limit: float


class VaultStatus(TypedDict):
    """Access of this service to the station's keys; if it has none, why, and the command that helps."""

    state: Literal["open", "locked"]
    problem: Problem | None


class Status(TypedDict):
    """The station, its links, measurements and sinks."""

    version: str
    station: StationName
    started: NotRequired[Time]
    time: Time
    url: str | None
    detection: Mode
    adopt: NotRequired[bool]
    actuators: NotRequired[
        Annotated[bool, Meta(description="whether set points arrive by topics where a measurement lets them")]
    ]
    dead_man: NotRequired[Annotated[int, Meta(description="ms, unless a measurement sets its own; also for requests")]]
    links: list[Link]
    nodes: NotRequired[int]
    strangers: NotRequired[int]
    clients: NotRequired[int]
    measurements: list[Measurement]
    sinks: list[Sink]
    foxglove: NotRequired[Annotated[str | None, Meta(description="address of the live Foxglove server, if one runs")]]
    clock_error: float | None
    budget: Budget
    plant: bool
    vault: NotRequired[VaultStatus]
    write: Annotated[bool, Meta(description="whether this token may change anything")]


class Change(TypedDict):
    """One field that writing a datasheet changes, in physical units."""

    channel: int
    access_code: NotRequired[int]
    field: str
    before: str
    after: str
    text: str


class Finding(TypedDict):
    """The guard's finding on a datasheet."""

    severity: str
    message: str
    hint: str


class Curve(TypedDict):
    """The calibration of a channel, to be drawn."""

    channel: int
    name: str
    x_unit: str
    y_unit: str
    points: Annotated[list[list[float | None]], Meta(description="raw, value; null: an angle goes on at its other end")]


class Sheet(OriginMember):
    """A node's datasheet, decoded and checked."""

    uuid: Uuid
    read_now: bool
    verdict: str
    at: str
    by: str
    checks: list[CheckMembers]
    teds: list[dict[str, Any]]
    guard: list[Finding]
    curves: list[Curve]


class DocumentBlock(TypedDict):
    """One TEDS of a document."""

    channel: int
    access_code: int
    octets: NotRequired[str]


class Document(TypedDict):
    """A datasheet as a JSON document."""

    format: Literal["teds/1"]
    teds: list[DocumentBlock]


class Step(TypedDict):
    """A step of work with a node."""

    name: str
    result: str
    detail: str
    seconds: NotRequired[float]


class SheetPlan(TypedDict):
    """Changes that writing a datasheet makes, or made."""

    uuid: Uuid
    dry_run: bool
    changes: list[Change]
    guard: list[Finding]
    steps: list[Step]
    verdict: str | None


class Provisioning(TypedDict):
    """A provisioning that waits, runs, or is over."""

    uuid: str
    state: Literal["waiting", "running", "done", "failed", "cancelled"]
    waits_for: Literal["tap"] | None
    until: float | None
    steps: list[Step]
    error: Problem | None
    verdict: str | None


class UpdateImage(TypedDict):
    """The firmware image of an update, by its file."""

    version: str
    digest: Annotated[str, Meta(description="MCUboot's, which boards report; not that of the file")]
    board: Annotated[str, Meta(description="the board that it names (TLV 0x54A0)")] | None
    octets: int
    security_counter: int | None


class UpdateBoard(_UpdateFrom):
    """One board of an update: the plan first, then what it does, then how it ended."""

    uuid: Uuid
    to: str
    state: Literal["planned", "waiting", "running", "ended", "skipped"]
    board: Annotated[str, Meta(description="the board that it reports to be")] | None
    plan: Annotated[Literal["upload", "restart", "prove", "nothing"], Meta(description="the first step")] | None
    octets: Annotated[int, Meta(description="to send; at the end, that were sent")]
    seconds: Annotated[float, Meta(description="about how long they take; at the end, how long it took")]
    interrupts: Annotated[list[str], Meta(description="measurements that pause")]
    question: Annotated[str, Meta(description="what a person must answer first (other_board), empty for nothing")]
    step: Literal["upload", "restart", "prove", "revert"] | None
    written: Annotated[int, Meta(description="octets that are on the board")]
    result: Literal["updated", "already", "reverted", "refused", "lost"] | None
    error: Problem | None


class UpdateTotals(TypedDict):
    """Boards by result, and the seconds in all."""

    updated: int
    already: int
    reverted: int
    refused: int
    lost: int
    seconds: float


class Update(TypedDict):
    """A firmware update of many boards: a plan (``planned``, without id), one that runs, or one that is over."""

    id: str | None
    state: Annotated[
        Literal["planned", "running", "done", "stopped"], Meta(description="stopped: not all boards were begun")
    ]
    owner: Annotated[str, Meta(description="who asked for it: page, api:TOKEN, ncap")]
    began: Time
    ended: Time | None
    image: UpdateImage
    allow_downgrade: bool
    parallel: int
    boards: list[UpdateBoard]
    totals: UpdateTotals


class Updates(TypedDict):
    """The update that runs, and the last ones that are over."""

    updates: list[Update]


class AppliedValue(TypedDict):
    """The value to which an actuator was set."""

    channel: int
    value: float
    unit: str
    raw: Any


class Applied(TypedDict):
    """Result of a set point."""

    applied: AppliedValue | None
    until: float | None
    safe: Annotated[bool, Meta(description="what the node itself said after it was let go")] | None


class Name(TypedDict):
    """The name and topic of a node or channel."""

    uuid: Uuid
    channel: int
    name: str | None
    topic: str


class Simulation(TypedDict):
    """The simulation that feeds a virtual transducer."""

    by: Annotated[str, Meta(description="page, ncap (the Unix socket) or api:TOKEN")]
    since: float
    lines: int
    skipped: int


class Virtual(TypedDict):
    """A virtual transducer of this station."""

    uuid: Uuid
    name: str
    source: str
    state: Literal["starting", "running", "ended"]
    why: NotRequired[str]
    channels: int
    simulation: Annotated[Simulation | None, Meta(description="who feeds it now, if its source is simulation")]


class Profile(TypedDict):
    """A transducer type that can be built."""

    name: str
    title: str


class Entry(TypedDict):
    """An entry of the audit log."""

    seq: int
    time: Time
    who: str
    actor: Annotated[str, Meta(description="the user, the name of a token, or page")]
    act: str
    uuid: Uuid | None
    subject: NotRequired[str]
    outcome: str
    detail: str
    facts: NotRequired[dict[str, Any]]
    failed: bool


# -- answers that hold one or several of the above ---------------------------------------------------------------------


class DetectionMode(TypedDict):
    """Which nodes the station looks at."""

    mode: Mode


class PlantStation(TypedDict):
    """State of a station of the plant: its newest page that counts, and seconds since that was made."""

    name: str
    fingerprint: str
    roles: list[str]
    page: int
    age: int | None
    state: str


class PlantConflict(TypedDict):
    """A node on which stations do not agree."""

    uuid: Uuid
    conflict: str
    detail: str


class PlantAlarm(TypedDict):
    """An alarm of the plant for an operator to note, or to decide."""

    code: str
    about: str
    why: str
    at: str
    seen: bool


class Plant(TypedDict):
    """The plant that this station belongs to; ``age`` in seconds since the last sync."""

    registry: str
    name: str
    roster: int
    expires: Time
    state: str
    why: str
    synced: Time | None
    age: float | None
    unsent: int
    to_rotate: int
    stations: list[PlantStation]
    conflicts: list[PlantConflict]
    alarms: list[PlantAlarm]


class PlantClaims(TypedDict):
    """The stations' claims about one node."""

    uuid: Uuid
    name: str | None
    says: dict[str, Any]
    conflicts: list[dict[str, Any]]


class PlantNodes(TypedDict):
    """Nodes whose UUID begins so, or whose name holds the text; ``more``: there are others."""

    nodes: list[PlantClaims]
    more: bool


class Job(TypedDict):
    """A job: boards that a keeper permits a line to build; ``units`` and ``passed`` are those of this station."""

    id: str
    title: str
    profile: str
    total: int
    ends: Time
    state: Literal["open", "closed"]
    units: int
    passed: int


class Jobs(TypedDict):
    """Every job that this station took, oldest first."""

    jobs: list[Job]


class LineStation(TypedDict):
    """One station's part of a job.

    ``first_pass`` is the share of its boards that passed at their first attempt; ``failures`` counts attempts by the
    code that ended them, ``steps`` holds median and worst seconds of each step: from evidence that is here, of other
    stations from their pages, which contain no seconds.
    """

    station: str
    name: str
    allotment: int
    units: int
    passed: int
    first_pass: float | None
    attempts: int
    over: bool
    failures: dict[str, Any]
    steps: dict[str, Any]


class JobStatus(Job):
    """Progress of a job, per station."""

    stations: list[LineStation]


class Found(TypedDict):
    """The nodes that answered."""

    nodes: list[Node]


class Nodes(Found):
    """A page of nodes, and how many there are in all."""

    total: int


class Groups(TypedDict):
    """Every measurement group."""

    groups: list[Group]


class Measurements(TypedDict):
    """Every measurement."""

    measurements: list[Measurement]


class Names(TypedDict):
    """Every name and topic."""

    names: list[Name]


class Virtuals(TypedDict):
    """Every virtual transducer."""

    virtual: list[Virtual]


class Profiles(TypedDict):
    """Every profile."""

    profiles: list[Profile]


class Log(TypedDict):
    """Entries of the audit log, and whether the log is intact."""

    entries: list[Entry]
    intact: bool
    why: NotRequired[str]


class Url(TypedDict):
    """An address."""

    url: str
