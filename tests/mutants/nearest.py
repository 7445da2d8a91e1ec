"""Which tests lie nearest to a mutant: by the graph of imports, and by the words that they share with its function."""

from __future__ import annotations

import ast
import math
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

from tests.mutants.changes import ROOT, Mutant, words_of
from tests.parsed import parsed

FAR = 9
_AFTER_THE_REST = ("tests/system/", "tests/page/", "tests/faults/", "tests/fuzz/", "tests/strangers/", "tests/mutants/")


class Suite:
    """The test files of the house, and how far each is from a module of the package."""

    def __init__(self, tests: Sequence[str] = ("",)) -> None:
        """``tests`` are the rooms of the tests that may be chosen: all, if none is named."""
        of_tests = (path for room in tests for path in (ROOT / "tests" / room).rglob("*.py"))
        paths = [*(ROOT / "teds_provision").rglob("*.py"), *of_tests]
        self._paths = {_dotted(path): path for path in paths}
        self._text = {name: path.read_text() for name, path in self._paths.items()}

    @cached_property
    def _imports(self) -> dict[str, set[str]]:
        return {name: set(self._of(name)) for name in self._paths}

    @cached_property
    def _distances(self) -> dict[str, dict[str, int]]:
        """Of every test file, in how many steps it comes to each module."""
        return {name: self._from(name) for name in self._paths if name.rpartition(".")[2].startswith("test_")}

    def nearest(self, mutant: Mutant, most: int) -> list[str]:
        """Paths of the test files to run, the most telling first; of the C library the one that its pattern names."""
        if not mutant.path.endswith(".py"):
            return [mutant.test]
        module = _dotted(ROOT / mutant.path)
        room = module.split(".")[1] if module.count(".") else ""
        words = {word: self._weights.get(word, 0.0) for word in mutant.words}
        whole = sum(words.values()) or 1.0
        ranks: list[tuple[float, str]] = []
        for name, distances in self._distances.items():
            path = self._paths[name].relative_to(ROOT).as_posix()
            near = float(distances.get(module, FAR))
            near -= 8.0 * sum(weight for word, weight in words.items() if word in self._words[name]) / whole
            near -= 1.0 * (f"tests/{room}/" in path) + 2.0 * (module.rpartition(".")[2] in name.rpartition(".")[2])
            near += 6.0 * path.startswith(_AFTER_THE_REST)
            ranks.append((near, path))
        found = [path for near, path in sorted(ranks)[:most] if near < FAR]
        return [mutant.test, *(path for path in found if path != mutant.test)] if mutant.test else found

    @cached_property
    def _words(self) -> dict[str, frozenset[str]]:
        """The words of every test file: names that it uses, cut where they are joined."""
        return {name: words_of(self._text[name]) for name in self._distances}

    @cached_property
    def _weights(self) -> dict[str, float]:
        """How much a word tells: the fewer test files have it, the more."""
        count = Counter(word for words in self._words.values() for word in words)
        return {word: math.log(len(self._words) / many) for word, many in count.items()}

    def _from(self, name: str) -> dict[str, int]:
        seen, queue = {name: 0}, deque([name])
        while queue:
            here = queue.popleft()
            for other in self._imports.get(here, ()):
                if other not in seen:
                    seen[other] = seen[here] + 1
                    queue.append(other)
        return seen

    def _of(self, name: str) -> Iterable[str]:
        """What a file imports, at its top or late; of a room also the modules that it takes from it by attribute."""
        of_interest = (ast.Import, ast.ImportFrom, ast.Attribute)
        nodes = [node for node in ast.walk(parsed(self._paths[name])) if isinstance(node, of_interest)]
        package = name if self._paths[name].name == "__init__.py" else name.rpartition(".")[0]
        rooms: dict[str, str] = {}
        for node in nodes:
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name in self._paths)
            elif isinstance(node, ast.ImportFrom):
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                for alias in node.names:
                    inner = f"{base}.{alias.name}"
                    if inner in self._paths:
                        rooms[alias.asname or alias.name] = inner
                        yield inner
                    elif base in self._paths:
                        yield base
        for node in nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in rooms:
                inner = f"{rooms[node.value.id]}.{node.attr}"
                if inner in self._paths:
                    yield inner


def _dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
