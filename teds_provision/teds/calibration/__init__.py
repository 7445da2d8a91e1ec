"""Calibration of a channel: the segmented multinomial, fits from measured points, files, and the way into the TEDS.

numpy is loaded when something is evaluated or fitted, not before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy
from teds_provision.teds.calibration.decoded import from_decoded
from teds_provision.teds.calibration.model import METHODS, Calibration, CalibrationInput, Method

if TYPE_CHECKING:
    from teds_provision.teds.calibration.describe import describe_calibration, kind_of, sentence
    from teds_provision.teds.calibration.files import load_calibrations, read_calibrations
    from teds_provision.teds.calibration.fitting import Residuals, fit, residuals
    from teds_provision.teds.calibration.formula import Evaluation, PreparedCurve, PreparedInverse, evaluate
    from teds_provision.teds.calibration.interpreter import ChannelInterpreter, Values
    from teds_provision.teds.calibration.reading import SampleReader

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
    "from_decoded",
    "kind_of",
    "load_calibrations",
    "read_calibrations",
    "residuals",
    "sentence",
]

__getattr__ = lazy(
    __name__,
    {
        "ChannelInterpreter": "interpreter",
        "Evaluation": "formula",
        "PreparedCurve": "formula",
        "PreparedInverse": "formula",
        "Residuals": "fitting",
        "SampleReader": "reading",
        "Values": "interpreter",
        "describe_calibration": "describe",
        "evaluate": "formula",
        "fit": "fitting",
        "kind_of": "describe",
        "load_calibrations": "files",
        "read_calibrations": "files",
        "residuals": "fitting",
        "sentence": "describe",
    },
)
