"""Coverage-guided fuzzing of one target with atheris, in an environment of its own.

Run: python tests/fuzz/run.py TARGET [options of libFuzzer], for example -runs=1000000. What it finds to be new goes to
build/fuzz/TARGET; an input that breaks something to build/crash-…. ``make fuzz`` runs every target.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIMITS = ["-rss_limit_mb=1024", "-timeout=10"]


def main() -> None:
    """Fuzz the target that the first argument names; memory, time and size of an input are bounded here."""
    import atheris

    name, *options = sys.argv[1:]
    sys.path.insert(0, str(ROOT))
    with atheris.instrument_imports(include=["teds_provision"]):
        from tests.fuzz.targets import TARGETS

        target = TARGETS[name]
        for seed in target.kept():  # loads what the target needs, instrumented
            target.check(seed)
    found = ROOT / "build" / "fuzz" / name
    found.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (found / f"seed-{number}").write_bytes(seed)
    words = found.parent / f"{name}.dict"
    words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
    corpus = ROOT / "tests" / "fuzz" / "corpus" / name
    places = [str(found), *([str(corpus)] if corpus.is_dir() else [])]
    artifacts = f"-artifact_prefix={ROOT / 'build'}/{name}-"
    dictionary = [f"-dict={words}"] if target.words else []
    atheris.Setup(
        [sys.argv[0], *LIMITS, f"-max_len={target.longest}", artifacts, *dictionary, *options, *places], target.check
    )
    atheris.Fuzz()


def _escaped(word: str) -> str:
    return "".join(
        chr(octet) if 32 <= octet < 127 and octet not in b'"\\' else f"\\x{octet:02X}" for octet in word.encode()
    )


if __name__ == "__main__":
    main()
