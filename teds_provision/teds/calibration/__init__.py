"""Calibration of a channel: the segmented multinomial, fits from measured points, files, and the way into the TEDS.

numpy is loaded when something is evaluated or fitted, not before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from teds_provision.teds.calibration.decoded import calibrations_of, from_decoded
from teds_provision.teds.calibration.describe import describe_calibration, kind_of, sentence
from teds_provision.teds.calibration.model import METHODS, Calibration, CalibrationInput, Evaluation, Method

if TYPE_CHECKING:
    from teds_provision.teds.calibration.files import load_calibrations, read_calibrations
    from teds_provision.teds.calibration.fitting import Residuals, fit

__all__ = [
    "METHODS",
    "Calibration",
    "CalibrationInput",
    "Evaluation",
    "Method",
    "Residuals",
    "calibrations_of",
    "describe_calibration",
    "fit",
    "from_decoded",
    "kind_of",
    "load_calibrations",
    "read_calibrations",
    "sentence",
]
_LAZY = {"Residuals": "fitting", "fit": "fitting", "load_calibrations": "files", "read_calibrations": "files"}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(name)
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
