"""The commented text that ``profile new`` writes: every key there is, made from the same tables that read it."""

from __future__ import annotations

from collections.abc import Iterable

from teds_provision.teds.calibration.model import METHODS
from teds_provision.teds.profile.interpret import TEXT_CLASSES
from teds_provision.teds.profile.keys import (
    CALIBRATION_KEYS,
    CHANNEL_KEYS,
    DATA_SET_KEYS,
    META_GROUPS,
    META_KEYS,
    MODELS,
    MODES,
    PHY_KEYS,
    Key,
    Need,
)


def template(name: str) -> str:
    """Text of a new profile: what is needed is filled with examples, what is optional stands as a comment."""
    return "\n".join(
        [
            f"# Transducer type {name}.",
            "# Adapt the figures; keys behind # are optional. Every key is explained in docs/profiles.md.",
            "",
            '# extends = "smart-sensor"          # take everything from another profile and change what is said here',
            f'title = "{name}"',
            'description = """',
            "What it measures, with which parts, and where the figures come from.",
            '"""',
            f'name = "{name}"                    # TIM name (XdcrName TEDS); up to 120 octets',
            'links = ["nfc", "can"]              # of nfc, can, ble; for people only',
            "",
            "[meta]                              # Meta-TEDS, access code 1; UUID and MaxChan are filled in",
            *_lines(META_KEYS),
            *_groups(),
            "# Each channel is a TransducerChannel TEDS, access code 3; [channel.1-12], [channel.all] say it for many.",
            "[channel.1]",
            'name = "channel 1"                  # {channel} stands for its number',
            'unit = "degree"                     # as people write it: N, mm, degC, m/s², mV/V, %, count, digital',
            '# display-unit = "degree"           # unit to show values in, where it is another',
            *_lines(CHANNEL_KEYS),
            f'# calibration-key = "auto"          # auto, {", ".join(CALIBRATION_KEYS)}',
            f"# models: {', '.join(MODELS)}",
            'sample = { model = "unsigned", octets = 2, bits = 16 }',
            f"# modes: {', '.join(MODES)}",
            'sampling = { modes = ["trigger", "continuous"], default = "continuous" }',
            "",
            "# [channel.1.data-set]",
            *_lines(DATA_SET_KEYS, comment=True),
            '# unit = "s"                        # unit of origin and step',
            "",
            "[channel.1.calibration]             # what is asked of the file given with --calibration",
            "required = false",
            f'# method = "table"                  # {", ".join(METHODS)}',
            "# degree = 3                        # of a polynomial",
            '# monotone = "increasing"           # increasing, decreasing, true (either)',
            '# interval = "1 year"               # due again after this time',
            "# raw-range = [0, 65535]            # raw values that the electronics can give",
            "# zero-offset = false               # the offset may be adjusted in use",
            "# standard-deviation = 0.5          # in the channel's unit, for people",
            "",
            "# [phy]                             # PHY TEDS of IEEE 1451.5, access code 13; many nodes bring their own",
            *_lines(PHY_KEYS, comment=True),
            "",
            "# [[text]]                          # a text-based TEDS",
            f'# kind = "title"                    # {", ".join(TEXT_CLASSES)}',
            "# channel = 0",
            '# language = "en"',
            '# xml = "<Title>Bench 3</Title>"',
            "",
        ]
    )


def _lines(keys: Iterable[Key], *, comment: bool = False) -> list[str]:
    return [_line(key, comment or key.need is Need.OPTIONAL) for key in keys]


def _line(key: Key, comment: bool) -> str:
    choices = f" ({', '.join(key.choices)})" if key.choices else ""
    text = f"{'# ' if comment else ''}{key.key} = {key.example}"
    return f"{text:<35} # {key.field}: {key.help}{choices}"


def _groups() -> list[str]:
    lines = [""]
    for key, (field, keys) in META_GROUPS.items():
        lines += [f"# [[meta.{key}]]  # {field}", *_lines(keys, comment=True), ""]
    return lines
