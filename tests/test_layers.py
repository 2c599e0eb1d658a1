"""What may import what (docs/map.md), no circles, and no module too long to be read at a sitting."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.paths import REPOSITORY

SOURCE = REPOSITORY / "src"
MAX_LINES = 400

NOUNS = {
    "geometry",
    "input_limits",
    "rig",
    "frames",
    "matches",
    "moments",
    "results",
    "status",
    "display",
    "view",
    "methods",
    "units",
    "comparison",
}
PARTS = {"sylvester", "absolute_pose", "features"}
FILES = {"atomic_io"}  # for whoever writes any
ESTIMATORS = PARTS | {"relative_pose", "landmarks", "bundle_adjustment", "tracking", "smoothing"}
# By room (the files at the root are rooms of one): what it may import besides itself.
ALLOWED: dict[str, set[str]] = {
    "geometry": set(),
    **dict.fromkeys(NOUNS - {"geometry", "input_limits"}, NOUNS),
    "input_limits": set(),
    **dict.fromkeys(PARTS, NOUNS),
    "relative_pose": NOUNS | {"sylvester"},
    "landmarks": NOUNS | {"features"},
    "boards": NOUNS | {"absolute_pose"},
    "bundle_adjustment": NOUNS | {"features", "absolute_pose", "landmarks"},
    "tracking": NOUNS | PARTS | {"relative_pose", "landmarks", "bundle_adjustment"},
    "smoothing": NOUNS | PARTS | {"relative_pose", "landmarks", "bundle_adjustment", "tracking"},
    "atomic_io": set(),
    "calibration": NOUNS | FILES,
    "report": NOUNS | FILES,
    "exports": NOUNS | FILES | {"report"},
    "simulate": NOUNS | FILES | {"calibration"},
    "capture": NOUNS | {"calibration"},
    "sync": NOUNS | {"capture"},
    "experiments": NOUNS | {"sylvester", "simulate", "report"},
    "network": NOUNS | PARTS | FILES | {"relative_pose", "landmarks", "tracking", "smoothing"},
    # Its results say which version made them.
    "archive": {""} | NOUNS | {"calibration", "capture", "sync", "report", "simulate", "app"},
}
# Where images are worked on, or read and written.
SEES_IMAGES = {"rig", "features", "boards", "tracking.region", "sync", "calibration", "capture", "report", "simulate"}


@cache
def modules() -> dict[str, Path]:
    """All modules by their names within the package; a room's `__init__` has the room's, the package's own is ""."""
    found = {}
    for path in sorted((SOURCE / "sylpose").rglob("*.py")):
        parts = path.relative_to(SOURCE / "sylpose").with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports(module: str) -> dict[str, bool]:
    """What a module imports, inside functions too: full names, and whether a type checker alone does."""
    tree = ast.parse(modules()[module].read_text(encoding="utf-8"))
    for_types = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for line in block.body
        for node in ast.walk(line)
    }
    found: dict[str, bool] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            found[name] = found.get(name, True) and id(node) in for_types
    return found


def imported_modules(module: str, types: bool) -> Iterator[str]:
    """The modules of the package that a module imports, with those that it needs for its types only or without them."""
    for name, for_types in imports(module).items():
        first, _, rest = name.partition(".")
        if first == "sylpose" and (types or not for_types):
            yield rest if rest in modules() else rest.rpartition(".")[0]


def room_of(module: str) -> str:
    return module.partition(".")[0]


INNER = [m for m in modules() if m not in ("", "__main__") and room_of(m) not in ("app", "cli")]


def test_every_room_has_its_place() -> None:
    assert {room_of(m) for m in INNER} == set(ALLOWED)


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_rooms_import_only_what_stands_above_them(room: str) -> None:
    wrong = [
        f"{module} imports {other or 'sylpose itself'}"
        for module in INNER
        if room_of(module) == room
        for other in imported_modules(module, types=True)
        if room_of(other) not in ALLOWED[room] | {room}
    ]
    assert not wrong


def test_no_estimator_reads_writes_or_simulates() -> None:
    """Follows from the table above, which must not be relaxed so."""
    for room in ESTIMATORS:
        assert not ALLOWED[room] & {
            "atomic_io",
            "capture",
            "calibration",
            "report",
            "exports",
            "sync",
            "simulate",
            "experiments",
            "app",
            "archive",
        }


def test_images_are_seen_in_few_places() -> None:
    wrong = [
        module
        for module in modules()
        if any(name.partition(".")[0] in ("cv2", "av") for name in imports(module))
        and not {module, room_of(module)} & SEES_IMAGES
    ]
    assert not wrong


def test_there_are_no_circles() -> None:
    """Neither of modules, whatever is loaded late, nor of rooms."""
    of_modules = {m: set(imported_modules(m, types=True)) - {m} for m in modules() if m}
    of_rooms: dict[str, set[str]] = {}
    for module, others in of_modules.items():
        of_rooms.setdefault(room_of(module), set()).update({room_of(o) for o in others} - {room_of(module), ""})
    for graph in (of_modules, of_rooms):
        # The package's own file loads the public names when they are asked for; those that import it want the version.
        kept = {module: others - {""} for module, others in graph.items()}
        try:
            TopologicalSorter(kept).prepare()
        except CycleError as error:
            pytest.fail(" -> ".join(error.args[1]))


def test_no_module_is_too_long() -> None:
    long = {m for m, path in modules().items() if len(path.read_text(encoding="utf-8").splitlines()) > MAX_LINES}
    assert long == set()
