"""Facts beside the type of a field, in ``Annotated``: :class:`Meta` for its JSON schema, :class:`CommandOption`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal


class Meta:
    """Schema keywords beside the type: ``Annotated[float, Meta(minimum=0)]``."""

    def __init__(self, **facts: Any) -> None:
        self.facts = facts


@dataclass(frozen=True)
class CommandOption:
    """The option of the command line that gives a field; type and bounds follow from the field (cli/shape_options.py).

    ``default`` is shown in the help; None: the field's own, which is not shown. ``unbounded`` leaves out the greatest
    value that the API has. ``reads``: what the text is, if that does not follow from the type.
    """

    flags: str
    help: str
    metavar: str | None = None
    default: Any = None
    unbounded: bool = False
    reads: Literal["", "channel", "file"] = ""
