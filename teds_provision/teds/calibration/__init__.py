"""Calibration of a channel: the segmented multinomial, fits from measured points, files, and the way into the TEDS.

numpy is loaded when something is evaluated or fitted, not before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy
from teds_provision.teds.calibration.model import METHODS, Calibration, CalibrationInput, Method, from_decoded
from teds_provision.teds.calibration.samples import SampleReader

if TYPE_CHECKING:
    from teds_provision.teds.calibration.files import fit_points, load_calibrations, read_calibrations
    from teds_provision.teds.calibration.formula import (
        Evaluation,
        PreparedCurve,
        PreparedInverse,
        Residuals,
        describe_calibration,
        evaluate,
        fit,
        kind_of,
        left_out,
        residuals,
        sentence,
    )
    from teds_provision.teds.calibration.interpreter import ChannelInterpreter, Values

__all__ = [
    "METHODS",
    "Calibration",
    "CalibrationInput",
    "ChannelInterpreter",
    "Evaluation",
    "Method",
    "PreparedCurve",
    "PreparedInverse",
    "Residuals",
    "SampleReader",
    "Values",
    "describe_calibration",
    "evaluate",
    "fit",
    "fit_points",
    "from_decoded",
    "kind_of",
    "left_out",
    "load_calibrations",
    "read_calibrations",
    "residuals",
    "sentence",
]

__getattr__ = lazy(
    __name__,
    {
        "files": "fit_points load_calibrations read_calibrations",
        "formula": "Evaluation PreparedCurve PreparedInverse Residuals describe_calibration evaluate fit kind_of"
        " left_out residuals sentence",
        "interpreter": "ChannelInterpreter Values",
        "samples": "SampleReader",
    },
)
