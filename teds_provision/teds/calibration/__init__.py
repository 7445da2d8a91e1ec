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
        "describe": "describe_calibration kind_of sentence",
        "files": "load_calibrations read_calibrations",
        "fitting": "Residuals fit residuals",
        "formula": "Evaluation PreparedCurve PreparedInverse evaluate",
        "interpreter": "ChannelInterpreter Values",
        "reading": "SampleReader",
    },
)
