"""A measurement's settings, from which everything else that has them follows.

One more setting is a field of :class:`MeasurementSpec` here, with its :class:`Meta` if the API has it and its
:class:`CommandOption` if ``measure`` has it, and a column in ``station/store/schema.py``. The option, the request body
and the answer with their schemas, the row, the request to each node and the client take it from here. Type checkers
read no annotation at run time, so its name is repeated twice below, in the typed dictionaries of request and answer;
``tests/api/test_measurement_spec.py`` holds the three together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final, Literal, NotRequired, Self, TypedDict, get_type_hints

from teds_provision.shapes.metadata import CommandOption, Meta

MeasurementKind = Literal["periodic", "event", "free"]
ChannelNumber = Annotated[int, Meta(minimum=1, maximum=255)]


@dataclass(frozen=True, kw_only=True)
class MeasurementSpec:
    """Which nodes to measure (a group, nodes by UUID, or those that match), and how (operation.md section 7).

    ``channels`` empty: every sensor. ``rate`` in Hz, None for that of the datasheets; ``kind`` None: as each channel
    is. ``sinks`` are the strings that name files and topics; ``actuators``: set points may come by them, with a
    ``dead_man`` in ms. ``scalar_rate`` in Hz is that of topics of one value. ``require`` is the text of a file of
    requirements, "" for none. ``match`` is the expression that selects nodes as they come (measure/matching.py), None
    for none; ``frozen``: membership is fixed at the start; no node joins or leaves.
    """

    group: Annotated[str | None, Meta()] = None
    uuids: Annotated[tuple[bytes, ...], Meta()] = ()
    match: Annotated[
        str | None,
        Meta(
            minLength=1,
            maxLength=1000,
            description="measure each node that comes: all, type:P, name:GLOB, group:G, …",
        ),
    ] = None
    frozen: Annotated[bool, Meta(description="no node joins later, and no writer has one released")] = False
    channels: Annotated[
        tuple[ChannelNumber, ...],
        Meta(),
        CommandOption(
            "--channel", "Only this channel, by number or name; repeatable.", metavar="CHANNEL", reads="channel"
        ),
    ] = ()
    rate: Annotated[
        float | None,
        Meta(minimum=0.001, maximum=1e6, description="Hz, else the datasheet's"),
        CommandOption("--rate", "Samples per second (default: from the datasheet).", metavar="HZ", unbounded=True),
    ] = None
    kind: Annotated[
        MeasurementKind | None,
        Meta(),
        CommandOption("--kind", "How the node samples (default: each channel's own kind)."),
    ] = None
    trigger: Annotated[
        bool, Meta(), CommandOption("--trigger", "Start all nodes at the same moment, with one frame.")
    ] = False
    test_pattern: Annotated[
        bool, CommandOption("--test-pattern", "Stream and check the test pattern instead of measuring.")
    ] = False
    unsigned: Annotated[
        bool,
        CommandOption("--unsigned", "Also record raw values of nodes with an unsigned datasheet, marked as such."),
    ] = False
    sinks: Annotated[
        tuple[Annotated[str, Meta(description="ros1, ros2, the name of a broker, or of a file")], ...], Meta()
    ] = ()
    actuators: Annotated[
        bool,
        Meta(description="may set points arrive by ROS topics; true by default"),
        CommandOption("--actuators/--no-actuators", "Accept set points from ROS topics.", default=True),
    ] = False
    dead_man: Annotated[
        int,
        Meta(minimum=20, maximum=10_000, description="ms, else the station's"),
        CommandOption(
            "--dead-man",
            "Time without set points before an actuator goes to its safe state.",
            metavar="MS",
            default=1000,
        ),
    ] = 1000
    require: Annotated[
        str,
        CommandOption(
            "--require", "Requirements of the task, checked against the datasheets.", metavar="FILE", reads="file"
        ),
    ] = ""
    scalar_rate: Annotated[
        float,
        Meta(minimum=0, maximum=1000, description="Hz, 10 by default"),
        CommandOption("--scalar-rate", "Rate of single-value topics.", metavar="HZ", default=10.0),
    ] = 10.0

    @classmethod
    def from_json(cls, members: Mapping[str, Any], **defaults: Any) -> Self:
        """Return the settings of a request body; ``defaults`` are those of members that are absent."""
        given = defaults | {name: value for name, value in members.items() if value is not None}
        if "uuids" in given:
            given["uuids"] = [bytes.fromhex(uuid) for uuid in given["uuids"]]
        lists = (name for name, value in given.items() if isinstance(value, list | tuple))
        return cls(**given | {name: tuple(dict.fromkeys(given[name])) for name in lists})

    def settings(self) -> dict[str, Any]:
        """Return every field of this class by its name, without those of a class below it."""
        return {name: getattr(self, name) for name in NAMES}

    def to_json(self) -> dict[str, Any]:
        """Return the members that an answer of the API has."""
        found: dict[str, Any] = {name: getattr(self, name) for name in PUBLISHED}
        lists = {name: list(value) for name, value in found.items() if isinstance(value, tuple)}
        return found | lists | {"uuids": [uuid.hex() for uuid in self.uuids]}


NAMES: Final = tuple(member.name for member in fields(MeasurementSpec))
HINTS: Final = get_type_hints(MeasurementSpec, include_extras=True)
OPTIONS: Final[Mapping[str, CommandOption]] = {
    name: fact for name in NAMES for fact in HINTS[name].__metadata__ if isinstance(fact, CommandOption)
}
"""The option of ``measure`` for each field that has one."""
PUBLISHED: Final = tuple(name for name in NAMES if any(isinstance(fact, Meta) for fact in HINTS[name].__metadata__))
"""The fields that the API has."""


class MeasurementMembers(TypedDict, total=False):
    """Members of a request that may be left out, for type checkers: what ``client.measure`` takes beside UUIDs."""

    group: str | None
    match: str | None
    frozen: bool
    channels: Sequence[int]
    rate: float | None
    kind: MeasurementKind | None
    trigger: bool
    sinks: Sequence[str]
    actuators: bool
    dead_man: int | None
    scalar_rate: float | None


class MeasurementSettings(TypedDict):
    """Settings as an answer has them; what a member means there, if that is more than in a request."""

    group: str | None
    match: Annotated[str | None, Meta(description="expression of the nodes to measure; uuids are those that match now")]
    frozen: bool
    channels: NotRequired[list[int]]
    rate: float | None
    kind: str | None
    trigger: bool
    sinks: list[str]
    actuators: Annotated[bool, Meta(description="whether set points arrive by topics")]
    dead_man: NotRequired[Annotated[int, Meta(description="ms after which an actuator without set points is safe")]]
    scalar_rate: Annotated[float, Meta(description="messages/s on a topic of one value")]
