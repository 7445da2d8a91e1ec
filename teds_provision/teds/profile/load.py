"""Finding profiles in their folders, and their inheritance."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import BadDataError, NotFoundError, StoreError
from teds_provision.files import read_limited
from teds_provision.limits import LIMITS
from teds_provision.teds.calibration.model import METHODS
from teds_provision.teds.profile.interpret import TEXT_CLASSES, interpret
from teds_provision.teds.profile.keys import (
    CALIBRATION_KEYS,
    CHANNEL_KEYS,
    CHANNEL_TYPES,
    DATA_SET_KEYS,
    META_GROUPS,
    META_KEYS,
    MODELS,
    MODES,
    PHY_KEYS,
    Key,
    KeyNeed,
)
from teds_provision.teds.profile.model import ChannelProfile, Profile
from teds_provision.teds.profile.reader import Problems, ProfileProblem, SourcePlace, TomlTable, parse, read_text

_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}\Z")
MAXIMUM_DEPTH: Final = 16


@dataclass(frozen=True)
class ListedProfile:
    """A profile in a folder; ``error`` is why it cannot be used."""

    name: str
    path: Path
    profile: Profile | None
    error: str = ""


@cache
def shipped_profiles() -> Path:
    """Return the folder of the shipped profiles: inside the installed package, or in the checkout."""
    package = Path(__file__).resolve().parents[2]
    installed = package / "shipped_profiles"
    return installed if installed.is_dir() else package.parent / "profiles"


def default_folders(home: Path | None = None) -> tuple[Path, ...]:
    """Return the folders of profiles in the order of the search: <home>/profiles, the shipped ones, ./profiles.

    So a stray file in the working folder never replaces a type that comes with the tool; one's own version of such a
    type is in the home, or is named by its path.
    """
    folders = [*([home / "profiles"] if home else []), shipped_profiles(), Path("profiles")]
    unique: dict[Path, Path] = {}
    for folder in folders:
        unique.setdefault(folder.resolve(), folder)
    return tuple(unique.values())


def load_profile(name_or_path: str | Path, folders: Sequence[Path] | None = None) -> Profile:
    """Read and check a profile by name (looked for in the folders) or by the path of its file.

    Raises NotFoundError (unknown name; lists the known ones), BadDataError (file, line, field and what is wrong there).
    """
    profile, problems = check(name_or_path, folders)
    name = profile.name if profile else str(name_or_path)
    found = Problems(list(problems))
    found.raise_errors(name)
    if profile is None:  # for mypy: without errors there is a profile
        raise BadDataError(f"The profile {name} cannot be read.")
    return profile


def parse_profile(text: str, name: str = "profile") -> Profile:
    """Return a profile from text without a file; what it extends is looked for in the default folders.

    Raises NotFoundError and BadDataError as ``load_profile`` does; ``name`` is the file that messages show.
    """
    path = Path(f"{name}.toml")
    table, lineage = _laid_over(parse(text, path.name), path, default_folders(), ())
    problems = Problems()
    profile = interpret(table, name, path.name, lineage, problems)
    problems.raise_errors(name)
    if profile is None:  # for mypy: without errors there is a profile
        raise BadDataError(f"The profile {name} cannot be read.")
    return profile


def is_profile_name(text: str) -> bool:
    """Return True if ``find_profile`` treats this as a name, looked for in the folders, and never as a path."""
    return _NAME.match(text) is not None and not text.endswith(".toml")


def passed_over(name: str, folders: Sequence[Path]) -> tuple[str, ...]:
    """Return sentences about files of that name that were not used, because an earlier folder has one."""
    if not is_profile_name(name):
        return ()
    found = [folder / f"{name}.toml" for folder in folders if (folder / f"{name}.toml").is_file()]
    return tuple(f"{other} was not used: {name} is {found[0]}. Give its path to use it." for other in found[1:])


def check(
    name_or_path: str | Path, folders: Sequence[Path] | None = None
) -> tuple[Profile | None, list[ProfileProblem]]:
    """Return all problems of a profile, errors and warnings; the profile itself if there is no error.

    Raises NotFoundError and, for a file that is not TOML or inherits in a circle, BadDataError.
    """
    path = find_profile(name_or_path, folders)
    places = default_folders() if folders is None else tuple(folders)
    table, lineage = _merged(path, places, ())
    problems = Problems()
    profile = interpret(table, path.stem, str(path), lineage, problems)
    return profile, problems.found


def find_profile(name_or_path: str | Path, folders: Sequence[Path] | None = None) -> Path:
    """Return the file of a profile; raises NotFoundError."""
    text = str(name_or_path)
    path = Path(text)
    if isinstance(name_or_path, Path) or path.suffix == ".toml" or path.parent != Path():
        if not path.is_file():
            raise NotFoundError(f"There is no profile file {path}.")
        return path
    return _by_name(text, default_folders() if folders is None else folders)


def _is_base(path: Path) -> bool:
    """Return True for a profile that is only a base for others; one that cannot be read is none."""
    try:
        return bool(re.search(r"(?m)^\s*abstract\s*=\s*true", path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError):
        return False


def _by_name(name: str, folders: Sequence[Path], besides: Sequence[Path] = ()) -> Path:
    if _NAME.match(name):
        for folder in folders:
            path = folder / f"{name}.toml"
            if path.is_file() and path.resolve() not in besides:
                return path
    known = sorted({path.stem for path in _files(folders) if not _is_base(path)})
    near = get_close_matches(name[:64], known, n=1, cutoff=0.5)
    guess = f'Did you mean "{near[0]}"? ' if near else ""
    raise NotFoundError(
        f'There is no profile "{name}".',
        hint=f"{guess}Known are: {', '.join(known) or 'none'}. Make one with: teds-provision profile new NAME",
    )


def _files(folders: Sequence[Path]) -> Iterator[Path]:
    for folder in folders:
        if folder.is_dir():
            yield from sorted(path for path in folder.glob("*.toml") if path.is_file())


def list_profiles(folders: Sequence[Path] | None = None) -> list[ListedProfile]:
    """Return every profile of the folders by name; one that hides another of the same name is listed alone."""
    found: dict[str, ListedProfile] = {}
    places = default_folders() if folders is None else folders
    for path in _files(places):
        if path.stem in found:
            continue
        try:
            profile, error = load_profile(path, places), ""
        except (BadDataError, NotFoundError, StoreError) as failure:  # StoreError: it may not be read
            profile, error = None, failure.message
        found[path.stem] = ListedProfile(path.stem, path, profile, error)
    return [found[name] for name in sorted(found)]


def _merged(path: Path, folders: Sequence[Path], chain: tuple[Path, ...]) -> tuple[TomlTable, tuple[str, ...]]:
    """Return the table of a profile's file merged over those that it extends, and their names from this one up."""
    return _laid_over(parse(read_text(path), str(path)), path, folders, (*chain, path.resolve()))


def _laid_over(
    table: TomlTable, path: Path, folders: Sequence[Path], chain: tuple[Path, ...]
) -> tuple[TomlTable, tuple[str, ...]]:
    """Return the same of a parsed table; ``chain`` are the files so far, its own included."""
    base = _extended(table, path, folders, chain)
    if base is None:
        return table, (path.stem,)
    below, lineage = _merged(base, folders, chain)
    inherited = {key: value for key, value in below.entries.items() if key not in ("abstract", "extends")}
    return TomlTable(inherited, below.where).merged(table), (path.stem, *lineage)


def _extended(table: TomlTable, path: Path, folders: Sequence[Path], chain: Sequence[Path]) -> Path | None:
    """Return the file of the profile that this one extends, None if it extends none; raises BadDataError."""
    entry = table.entries.get("extends")
    if entry is None:
        return None
    where = entry.where
    if isinstance(entry, TomlTable) or not isinstance(entry.value, str):
        raise BadDataError(f'{where}: extends: the name of one profile is expected, like extends = "smart-sensor".')
    base = _base(entry.value, where, path, folders, chain)
    if len(chain) > MAXIMUM_DEPTH:
        raise BadDataError(f"{where}: extends: more than {MAXIMUM_DEPTH} profiles extend each other.")
    return base


def files_digest(path: Path, folders: Sequence[Path]) -> str:
    """Return the SHA-256 (hex) of the files that a profile is made of.

    Of one file its own; of one that extends others, over the files from the outermost base to the file itself, each
    preceded by its length as u32 (contract/plant.md section 9). Raises NotFoundError, BadDataError.
    """
    chain: tuple[Path, ...] = ()
    octets: list[bytes] = []
    following: Path | None = path
    while following is not None:
        chain = (*chain, following.resolve())
        octets.append(read_limited(following, LIMITS.text_file, "profile", failure=StoreError))
        following = _extended(parse(read_text(following), str(following)), following, folders, chain)
    if len(octets) == 1:
        return hashlib.sha256(octets[0]).hexdigest()
    framed = (len(file).to_bytes(4, "big") + file for file in reversed(octets))
    return hashlib.sha256(b"".join(framed)).hexdigest()


def _base(name: str, where: SourcePlace, path: Path, folders: Sequence[Path], chain: Sequence[Path]) -> Path:
    beside = (path.parent,) if chain else ()  # a text without a file has nothing beside it
    places = list(dict.fromkeys((*beside, *folders)))
    try:
        return _by_name(name, places, chain)
    except NotFoundError as error:
        if any((folder / f"{name}.toml").resolve() in chain for folder in places):
            circle = " -> ".join([*(path.stem for path in chain), name])
            raise BadDataError(f"{where}: extends: the profiles extend each other in a circle: {circle}.") from error
        raise BadDataError(f"{where}: extends: {error.message}", hint=error.hint) from error


# A profile as plain data, in its author's units: for ``profile show`` and JSON.

_TYPES: Final = {code: name for name, code in CHANNEL_TYPES.items()}


def describe(profile: Profile) -> dict[str, Any]:
    """Return plain data of a profile; limits and uncertainty in the channel's own unit, times in seconds."""
    return {
        **summary(profile),
        "description": profile.description,
        "node_name": profile.tim_name,
        "extends": list(profile.lineage[1:]),
        "meta": {name: value for name, value in profile.meta if isinstance(value, (int, float))},
        "channels": [describe_channel(channel) for channel in profile.channels],
        "firmware": None
        if profile.firmware is None
        else asdict(profile.firmware) | {"bad": list(profile.firmware.bad)},
        "warnings": list(profile.warnings),
    }


def summary(profile: Profile) -> dict[str, Any]:
    """Return the line of a profile in a list."""
    return {
        "name": profile.name,
        "title": profile.title,
        "file": profile.file,
        "abstract": profile.abstract,
        "links": list(profile.links),
        "channels": len(profile.channels),
    }


def listed(entry: ListedProfile) -> dict[str, Any]:
    """Return the line of a file found in a folder, with its error if it cannot be used."""
    if entry.profile is None:
        return {"name": entry.name, "file": str(entry.path), "error": entry.error}
    return summary(entry.profile)


def describe_channel(channel: ChannelProfile) -> dict[str, Any]:
    """Return plain data of one channel."""
    unit, demand = channel.unit, channel.calibration
    period = channel.fields.get("SPeriod")
    return {
        "number": channel.number,
        "name": channel.name,
        "type": _TYPES.get(channel.type, str(channel.type)),
        "unit": unit.text,
        "low_limit": unit.from_si(channel.low_limit),
        "high_limit": unit.from_si(channel.high_limit),
        "uncertainty": unit.difference_from_si(channel.uncertainty),
        "frame": channel.frame or None,
        "raw_range": list(channel.raw_range) if channel.raw_range else None,
        "sampling_period": period if isinstance(period, (int, float)) else None,
        "calibration": {
            "required": demand.required,
            "method": demand.method,
            "degree": demand.degree,
            "monotone": demand.monotone,
            "interval": demand.interval,
            "zero_offset": demand.zero_offset,
            "standard_deviation": demand.standard_deviation,
        },
    }


# The commented text that ``profile new`` writes: every key, generated from the tables that the reader uses.


def template(name: str) -> str:
    """Return the text of a new profile: required keys have examples, optional ones are comments."""
    lines = [""]
    for key, (field, keys) in META_GROUPS.items():
        lines += [f"# [[meta.{key}]]  # {field}", *_lines(keys, comment=True), ""]
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
            *lines,
            "# Each channel is a TransducerChannel TEDS, access code 3; [channel.1-12], [channel.all] say it for many.",
            "[channel.1]",
            'name = "channel 1"                  # {channel} stands for its number',
            'unit = "degree"                     # as people write it: N, mm, degC, m/s², mV/V, %, count, digital',
            '# display-unit = "degree"           # unit to show values in, where it is another',
            '# frame = "{node}_link"             # coordinate frame of its values (ROS); {node} is the node\'s name',
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
            "# indication = [0.01, -40.0]        # slope, intercept: what a raw value indicates before calibration",
            "# zero-offset = false               # the offset may be adjusted in use",
            "# standard-deviation = 0.5          # in the channel's unit; variance of topics",
            "",
            "# [firmware]                        # which firmware boards of this type should run, as they report it",
            '# text = "*/loadcell"               # board and application; *, ? and [...] as in file names',
            '# minimum = "1.2.0"',
            '# bad = ["1.2.1", "1.3.0+7"]        # versions, or digests of images (64 hex digits)',
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
    return [_line(key, comment or key.need is KeyNeed.OPTIONAL) for key in keys]


def _line(key: Key, comment: bool) -> str:
    choices = f" ({', '.join(key.choices)})" if key.choices else ""
    text = f"{'# ' if comment else ''}{key.key} = {key.example}"
    return f"{text:<35} # {key.field}: {key.help}{choices}"
