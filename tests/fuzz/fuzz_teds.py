"""Coverage-guided fuzzing of the TEDS codec (atheris), and the same check for a replay without it.

Run: python tests/fuzz/fuzz_teds.py tests/fuzz/corpus -max_total_time=600

The first octet of an input chooses: even, the rest goes to the decoder as it is; odd, the rest is a data block and
gets a right Length and checksum first, so that the fuzzer need not find one. Nothing but BadData may come out, and that
only where it is documented; what is read must be given back.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMITS = ["-rss_limit_mb=512", "-max_len=4096", "-timeout=10"]


def check(data: bytes) -> None:
    """Read one input in every way there is; raises AssertionError, or whatever should not have come out."""
    from teds_provision import teds
    from teds_provision.errors import BadData
    from teds_provision.teds.codec.frame import frame

    if not data:
        return
    octets = frame(data[1:]) if data[0] & 1 else data[1:]
    decoded = teds.decode(octets)
    assert teds.encode(decoded) == octets
    errors = [finding for finding in decoded.findings if finding.severity == "error"]
    assert bool(errors) == (decoded.verdict not in {"clean", "block-clean", "message"})
    try:
        teds.decode(octets, strict=True)
        assert not errors
    except BadData:
        assert errors
    try:
        again = teds.recompose(decoded)
    except BadData:
        assert decoded.verdict in {"malformed", "message"}
    else:
        assert again == octets or decoded.verdict not in {"clean", "block-clean"}
    for edition in (2007, 2024):
        try:
            other, findings = teds.convert(decoded, edition)
        except BadData:
            continue
        if decoded.verdict == "clean" and not findings:
            assert teds.decode(other).edition == edition
            assert teds.decode(other).verdict == "clean"
    for field in decoded.fields:
        teds.unpack_uuid(field.raw)
        teds.read_key(field.raw)


def main() -> None:
    """Fuzz with atheris; arguments are those of libFuzzer, memory and size of an input are bounded here."""
    import atheris

    sys.path.insert(0, str(ROOT))
    with atheris.instrument_imports(include=["teds_provision"]):
        import teds_provision.teds.codec.composer
        import teds_provision.teds.codec.content
        import teds_provision.teds.codec.editions
        import teds_provision.teds.codec.keyforms
        import teds_provision.teds.codec.security
        import teds_provision.teds.codec.tables.calibration
        import teds_provision.teds.codec.text
        import teds_provision.teds.codec.uuid  # noqa: F401
    atheris.Setup([sys.argv[0], *LIMITS, *sys.argv[1:]], check)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
