"""Each step of a workflow is recorded before and after, so that a killed run leaves what it was at."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from teds_provision.errors import TedsProvisionError
from teds_provision.station.station import Station
from teds_provision.talk.conversation import Conversation

Rest = ParamSpec("Rest")
Result = TypeVar("Result")
Target = TypeVar("Target", bytes, Conversation)


def recorded(
    step: str,
) -> Callable[
    [Callable[Concatenate[Station, Target, Rest], Result]], Callable[Concatenate[Station, Target, Rest], Result]
]:
    """Record a step of the node that the second argument is, or is talking to: open before, its result after."""

    def wrapper(
        work: Callable[Concatenate[Station, Target, Rest], Result],
    ) -> Callable[Concatenate[Station, Target, Rest], Result]:
        @wraps(work)
        def run(station: Station, target: Target, /, *args: Rest.args, **rest: Rest.kwargs) -> Result:
            if rest.get("keep_draft") is False:  # build, for a dry run: not even a trace
                return work(station, target, *args, **rest)
            uuid = cast(bytes, getattr(cast(Any, target), "uuid", target))
            row = station.store.begin_step(uuid, step)
            result = "interrupted"
            try:
                done = work(station, target, *args, **rest)
                result = "done"
                return done
            except TedsProvisionError as error:
                result = error.code
                raise
            finally:
                station.store.end_step(row, result)

        return run

    return wrapper
