"""Path of one ordinary frame through the package: files, functions, and changes of the floor.

    python benchmarks/frame_path.py [--frames 30] [--outline]

Tracks the demo scene with boxes and records every call of the package's Python functions. Compiled kernels, generated
methods and comprehensions are part of their callers. An ordinary frame is tracked by KLT alone: no initialization, no
new anchor, no refinement, no search. Of those frames it takes the one with the median number of functions.

A module's *floor* is its height in the import graph: 0 if it imports no other module of the package, else one more than
the highest floor that it imports. The *path* lists each function once, in the order of the first calls. Counted are:

- *files*, *functions*: what a reader has to open to follow the frame; *vocabulary*: files of `geometry/` and at the
  package's root (rig, frames, results) among them, which a reader knows from elsewhere;
- *returns to a higher floor*: how often the next function of the path is on a higher floor than the one before, so
  that the reader, having gone down, has to go up again;
- *calls upwards*: different pairs of functions of which the caller's floor is lower than the called one's.

Prints a table; with `--outline` also the path, indented by calls.
"""

from __future__ import annotations

import argparse
import ast
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

import sylpose
from sylpose import FrameSet
from sylpose.frames import Box
from sylpose.simulate import compute_demo_truth, make_demo_scene, render_frames
from sylpose.tracking.tracker import Tracker, track

__all__ = ["Call", "FramePath", "choose_median", "compute_floors", "record_paths"]

SOURCE = Path(sylpose.__file__).parent
# Initial frames that do not count: the first ones are refined at every step.
N_WARM_UP = 14
# Functions that an ordinary frame does not call.
UNUSUAL = {"detect_features", "refine_window", "_apply_refinement", "begin_preparation", "_join_camera"}
# Generated code and comprehensions are part of their callers.
INNER = {"<listcomp>", "<setcomp>", "<dictcomp>", "<genexpr>", "<module>"}


class Call(NamedTuple):
    """First call of a function: module, name, floors of it and its caller, and depth of calls."""

    module: str
    name: str
    floor: int
    depth: int


class FramePath(NamedTuple):
    """Functions of one frame in the order of their first calls, and pairs of functions called upwards."""

    calls: tuple[Call, ...]
    upwards: frozenset[tuple[str, str]]

    @property
    def files(self) -> int:
        """Number of files."""
        return len({call.module for call in self.calls})

    @property
    def vocabulary(self) -> int:
        """Number of files of `geometry` and at the root among them."""
        modules = {call.module for call in self.calls}
        return sum("." not in module or module.startswith("geometry.") for module in modules)

    @property
    def returns(self) -> int:
        """Number of returns to a higher floor."""
        floors = [call.floor for call in self.calls]
        return sum(later > earlier for earlier, later in pairwise(floors))

    @property
    def is_ordinary(self) -> bool:
        """Whether the frame is tracked by KLT alone."""
        return not UNUSUAL & {call.name for call in self.calls}


@cache
def _read_modules() -> dict[str, Path]:
    names = {}
    for path in SOURCE.rglob("*.py"):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


def _list_imports(module: str) -> Iterator[str]:
    """List the modules that a module imports, without those for type annotations only."""
    modules, tree = _read_modules(), ast.parse(_read_modules()[module].read_text(encoding="utf-8"))
    for_types = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in ast.walk(block)
    }
    for node in ast.walk(tree):
        if (
            not isinstance(node, ast.ImportFrom)
            or id(node) in for_types
            or not (node.module or "").startswith("sylpose")
        ):
            continue
        for alias in node.names:
            name = f"{node.module}.{alias.name}".removeprefix("sylpose.")
            yield name if name in modules else name.rpartition(".")[0]


def compute_floors() -> dict[str, int]:
    """Return each module's height in the import graph."""
    floors: dict[str, int] = {"": 0}

    def visit(module: str) -> int:
        if module not in floors:
            floors[module] = max((1 + visit(other) for other in set(_list_imports(module)) - {module}), default=0)
        return floors[module]

    for module in _read_modules():
        visit(module)
    return floors


class _Recorder:
    """Profiler of the package's functions in all threads."""

    def __init__(self) -> None:
        self._floors = compute_floors()
        self._modules = {str(path): module for module, path in _read_modules().items()}
        self.calls: dict[str, Call] = {}
        self.upwards: set[tuple[str, str]] = set()
        self.is_on = False

    def _describe(self, code: CodeType) -> tuple[str, str] | None:
        """Return a function's module and name, None for code that is not counted."""
        module = self._modules.get(code.co_filename)
        return None if module is None or code.co_name in INNER else (module, getattr(code, "co_qualname", code.co_name))

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        # Background work belongs to no frame; frames of compiled kernels have no caller.
        is_counted = self.is_on and event == "call" and frame.f_back is not None and _is_of_tracker()
        if not is_counted or (described := self._describe(frame.f_code)) is None:
            return
        callers = self._find_callers(frame)
        module, name = described
        floor, key = self._floors[module], ".".join(described)
        self.calls.setdefault(key, Call(module, name, floor, len(callers)))
        if callers and self._floors[callers[0][0]] < floor:
            self.upwards.add((".".join(callers[0]), key))

    def _find_callers(self, frame: FrameType) -> list[tuple[str, str]]:
        """Return the package's functions on the stack, the nearest first; a worker continues the main thread's stack."""
        main = sys._current_frames().get(threading.main_thread().ident or 0)
        stacks = [frame.f_back] if threading.current_thread() is threading.main_thread() else [frame.f_back, main]
        found = []
        for top in stacks:
            while top is not None:
                if (described := self._describe(top.f_code)) is not None:
                    found.append(described)
                top = top.f_back
        return found


def _is_of_tracker() -> bool:
    """Return whether this is the main thread or a worker of the tracker."""
    thread = threading.current_thread()
    return thread is threading.main_thread() or thread.name.startswith("camera")


@contextmanager
def _profile() -> Iterator[_Recorder]:
    recorder = _Recorder()
    threading.setprofile(recorder)
    sys.setprofile(recorder)
    try:
        yield recorder
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def record_paths(frames: int) -> list[FramePath]:
    """Track the demo scene and return the path of each frame after the first ones."""
    scene = make_demo_scene(frames=60, angle_deg=60.0, size=(320, 240), n_cameras=3)
    boxes = {name: Box(*box) for name, box in compute_demo_truth(scene).boxes.items()}
    nothing = (None,) * len(scene.rig)
    sets = [
        FrameSet(k, k / 30.0, nothing, images, nothing)
        for k, images in zip(range(frames), render_frames(scene), strict=False)
    ]
    list(track(sets, scene.rig, boxes))  # compiles what is not cached, which takes long while profiling
    paths = []
    with _profile() as recorder, Tracker(scene.rig, boxes, workers=1) as tracker:
        for k, images in enumerate(sets):
            recorder.calls, recorder.upwards, recorder.is_on = {}, set(), k >= N_WARM_UP
            tracker.step(images)
            recorder.is_on = False
            if recorder.calls:
                paths.append(FramePath(tuple(recorder.calls.values()), frozenset(recorder.upwards)))
    return paths


def choose_median(paths: Sequence[FramePath]) -> FramePath:
    """Return the path with the median number of functions."""
    return sorted(paths, key=lambda path: len(path.calls))[len(paths) // 2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--outline", action="store_true")
    options = parser.parse_args()
    paths = record_paths(options.frames)
    ordinary = [path for path in paths if path.is_ordinary]
    path = choose_median(ordinary)
    if options.outline:
        for call in path.calls:
            print(f"{'  ' * (call.depth - 1)}{call.module}.{call.name}  [{call.floor}]")
        print(*(" -> ".join(pair) for pair in sorted(path.upwards)), sep="\n", end="\n\n")
    print("| frames | ordinary | files | vocabulary | functions | returns to a higher floor | calls upwards |")
    print("|---|---|---|---|---|---|---|")
    counts = f"{path.files} | {path.vocabulary} | {len(path.calls)} | {path.returns} | {len(path.upwards)}"
    print(f"| {len(paths)} | {len(ordinary)} | {counts} |")


if __name__ == "__main__":
    main()
