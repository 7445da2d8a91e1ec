"""Options of the command line made from the fields of a shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import NoneType
from typing import Any, Final, Literal, TypeVar, get_args, get_origin

import click

from teds_provision.cli.options import ChannelName, FileToRead, Number, WholeNumber
from teds_provision.shapes import measurement
from teds_provision.shapes.metadata import CommandOption, Meta

Function = TypeVar("Function", bound=Callable[..., Any])

_OWN_TYPES: Final[dict[str, Callable[[], click.ParamType[Any]]]] = {"channel": ChannelName, "file": FileToRead}


def measurement_options(*names: str, but: tuple[str, ...] = ()) -> Callable[[Function], Function]:
    """Add the options of these settings of a measurement, by default of all but ``but``, in the order of the fields."""
    chosen = names or tuple(name for name in measurement.OPTIONS if name not in but)

    def add(function: Function) -> Function:
        for name in reversed(chosen):
            function = _option(name, measurement.HINTS[name], measurement.OPTIONS[name])(function)
        return function

    return add


def measurement_option(name: str, *, purpose: str) -> Callable[[Function], Function]:
    """Add the option of one setting to a command in which it has another help text."""
    return _option(name, measurement.HINTS[name], replace(measurement.OPTIONS[name], help=purpose))


def _option(name: str, hint: Any, option: CommandOption) -> Callable[[Function], Function]:
    """Return the option of one field, whose type its annotation has."""
    whole, *facts = get_args(hint)
    [kind] = [part for part in get_args(whole) if part is not NoneType] if NoneType in get_args(whole) else [whole]
    settings: dict[str, Any] = {"help": option.help, "metavar": option.metavar}
    if option.default is not None:
        settings |= {"default": option.default, "show_default": True}
    if kind is bool:
        settings |= {} if "/" in option.flags else {"is_flag": True}
    elif option.reads:
        settings["type"] = _OWN_TYPES[option.reads]()
    elif get_origin(kind) is Literal:
        settings["type"] = click.Choice(get_args(kind))
    else:
        schema = {word: value for fact in facts if isinstance(fact, Meta) for word, value in fact.facts.items()}
        most = None if option.unbounded else schema.get("maximum")
        settings["type"] = {int: WholeNumber, float: Number}[kind](schema.get("minimum"), most)
    if get_origin(kind) is tuple:
        settings["multiple"] = True
    return click.option(option.flags, name, **settings)
