"""Profiles: one TOML file per transducer type, inherited, checked, and built into the TEDS of a node.

Pure but for reading the files themselves. ``load_profile`` finds and checks, :meth:`Profile.build` makes the TEDS.
"""

from teds_provision.teds.profile.load import (
    ListedProfile,
    check,
    default_folders,
    describe,
    describe_channel,
    find_profile,
    is_profile_name,
    list_profiles,
    listed,
    load_profile,
    passed_over,
    shipped_profiles,
    summary,
    template,
)
from teds_provision.teds.profile.model import BuiltDatasheet, CalibrationDemand, ChannelProfile, Profile, TextProfile
from teds_provision.teds.profile.reader import ProfileProblem

__all__ = [
    "BuiltDatasheet",
    "CalibrationDemand",
    "ChannelProfile",
    "ListedProfile",
    "Profile",
    "ProfileProblem",
    "TextProfile",
    "check",
    "default_folders",
    "describe",
    "describe_channel",
    "find_profile",
    "is_profile_name",
    "list_profiles",
    "listed",
    "load_profile",
    "passed_over",
    "shipped_profiles",
    "summary",
    "template",
]
