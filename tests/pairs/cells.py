"""One cell of the pair bench: a change beside a long run, at one of three times, and everything that must hold then."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from tests.pairs.changes import CHANGES, Change
from tests.pairs.long_runs import LONG_RUNS, LongRun
from tests.pairs.scene import NODES, Outcome, Scene, Scenes
from tests.zygote import Child

BEFORE: Final = "before"
DURING: Final = "during"
AFTER: Final = "after"
TIMES: Final = (BEFORE, DURING, AFTER)
"""When the change starts: an instant before the long run, while that works, or as that is asked to end."""
_JUDGED: Final = ("target", "bystander", "handed")


@dataclass(frozen=True)
class Cell:
    """A change, the name of a long run, and when the change starts."""

    change: Change
    run: str
    when: str

    def __str__(self) -> str:
        return f"{self.change.name} {self.when} {self.run}"


@dataclass(frozen=True)
class CellResult:
    """The complaints of a cell, none if everything holds; ``seconds`` is what it took."""

    cell: Cell
    complaints: tuple[str, ...]
    seconds: float


def all_cells() -> Iterator[Cell]:
    """Yield every cell of the bench, change by change."""
    for change in CHANGES:
        for run in change.beside:
            for when in TIMES:
                yield Cell(change, run, when)


def run_cell(scenes: Scenes, cell: Cell, *, punctual: bool = True) -> CellResult:
    """Run one cell in a copy of its scene; ``punctual``: the machine is quiet enough for rules about time."""
    began = time.monotonic()
    kind = LONG_RUNS[cell.run]
    with scenes.copy(kind.of) as scene:
        change = cell.change
        long_run = kind(scene, leaves=change.leaves, touches=change.touches, punctual=punctual)
        long_run.codes = change.ends.get(cell.run, long_run.codes)
        long_run.line_codes = change.ends.get("the line", (0,))
        try:
            complaints = _meet(scene, cell, long_run)
        except AssertionError as failure:
            complaints = [f"the cell broke off: {failure}"]
        finally:
            if long_run.child is not None:
                long_run.child.close()
    return CellResult(cell, tuple(complaints), time.monotonic() - began)


def _meet(scene: Scene, cell: Cell, long_run: LongRun) -> list[str]:
    """Start both at the time of the cell, and return what does not hold."""
    change = cell.change
    long_run.power()
    if cell.when == BEFORE:
        changing = _start(scene, change)
        long_run.start()
        ended = _end(scene, changing)
        _follow(scene, change, long_run, ended)
        long_run.reach_work()
        long_run.change_made()
        long_run.stop()
        long_run.end()
    elif cell.when == DURING:
        _work_undisturbed(long_run)
        ended = _end(scene, _start(scene, change))
        _follow(scene, change, long_run, ended)
        long_run.change_made()
        long_run.stop()
        long_run.end()
    else:
        _work_undisturbed(long_run)
        long_run.stop()
        ended = _end(scene, _start(scene, change))
        _follow(scene, change, long_run, ended)
        long_run.end()
    complaints = [] if _locked_out(cell, long_run) else long_run.complaints
    return [*_change_holds(scene, cell, long_run, ended), *complaints, *_store_holds(scene, cell, ended)]


def _locked_out(cell: Cell, long_run: LongRun) -> bool:
    """Return True if the long run began with a passphrase that the change replaced before it was used: exit 7."""
    ended = long_run.ended
    return cell.when == BEFORE and cell.change.locks_out and ended is not None and not ended.is_bug and ended.code == 7


def _start(scene: Scene, change: Change) -> Child | None:
    """Start the command of a change, or make its edit at once."""
    if change.edit is not None:
        change.edit(scene)
        return None
    return scene.start(*change.words)


def _end(scene: Scene, changing: Child | None) -> Outcome:
    return scene.end_of(changing) if changing is not None else Outcome(0, "", "")


def _work_undisturbed(long_run: LongRun) -> None:
    """Let the long run reach its work as if there were no change."""
    leaves, long_run.leaves = long_run.leaves, ()
    long_run.start()
    long_run.reach_work()
    long_run.leaves = leaves


def _follow(scene: Scene, change: Change, long_run: LongRun, ended: Outcome) -> None:
    """Take note of what the change did; expect nothing of the long run on account of one that was refused."""
    if change.after is not None:
        change.after(scene, ended)
    if ended.code:
        long_run.leaves = ()


def _change_holds(scene: Scene, cell: Cell, long_run: LongRun, ended: Outcome) -> list[str]:
    """Compare the exit code of the change with the store, and repeat the change."""
    change = cell.change
    differences = []
    may_refuse = change.refused is not None and long_run.measures
    if ended.is_bug or (ended.code and not (may_refuse and ended.code == change.refused)):
        differences.append(f"{change.name}: {ended}")
    if change.done(scene) is not (ended.code == 0):
        differences.append(
            f"{change.name} ended with {ended.code}, its effect is {'' if ended.code else 'not '}in the store"
        )
    if change.edit is not None:
        return differences
    again = scene.run(*change.words)
    if again.is_bug or again.code not in change.again:
        differences.append(f"{change.name}, repeated alone: {again}")
    if change.after is not None:
        change.after(scene, again)
    if not change.done(scene):
        differences.append(f"{change.name}, repeated alone, has no effect in the store")
    return differences


def _store_holds(scene: Scene, cell: Cell, ended: Outcome) -> list[str]:
    """Look at what no change may break: the log, every key, the verdicts, and rows that no process owns."""
    differences = []
    log = scene.run("log")
    if log.code or not log.lines[-1]["intact"]:
        differences.append(f"the audit log does not hold: {log}")
    opened = scene.run("vault", "rewrap", "--yes")
    if opened.code:
        differences.append(f"not every key opens: {opened}")
    for name in _JUDGED:
        wanted = cell.change.verdicts.get(name, 0)
        verified = scene.run("verify", NODES[name], "BUS")
        if verified.code != wanted:
            differences.append(f"verify {name} ends with {verified.code}, not {wanted}: {verified}")
    if rows := scene.count("SELECT count(*) FROM measurements"):
        differences.append(f"{rows} measurements of commands that have ended are in the store")
    return differences


def cell_named(name: str) -> Cell:
    """Return the cell that prints as ``name``; raises KeyError."""
    return {str(cell): cell for cell in all_cells()}[name]
