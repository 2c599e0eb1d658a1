"""Allowed imports between packages (docs/map.md), no cycles, and a limit on module length."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.paths import REPOSITORY

SOURCE = REPOSITORY / "src"
# Lines of code: without docstrings, comments and blank lines.
MAX_CODE_LINES = 600

NOUNS = {
    "geometry",
    "input_limits",
    "rig",
    "frames",
    "matches",
    "mesh",
    "moments",
    "joint_motion",
    "kinematics",
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
ESTIMATORS = PARTS | {"relative_pose", "landmarks", "bundle_adjustment", "tracking", "smoothing", "silhouettes"}
# Allowed imports of each package besides itself (files at the root count as packages).
ALLOWED: dict[str, set[str]] = {
    "geometry": set(),
    **dict.fromkeys(NOUNS - {"geometry", "input_limits"}, NOUNS),
    "input_limits": set(),
    "packets": {"geometry"},
    **dict.fromkeys(PARTS, NOUNS),
    "sylvester": NOUNS | {"packets"},
    "relative_pose": NOUNS | {"sylvester"},
    "landmarks": NOUNS | {"features"},
    "boards": NOUNS | {"absolute_pose"},
    "bundle_adjustment": NOUNS | {"features", "absolute_pose", "landmarks"},
    "tracking": NOUNS | PARTS | {"relative_pose", "landmarks", "bundle_adjustment"},
    "smoothing": NOUNS | PARTS | {"relative_pose", "landmarks", "bundle_adjustment", "tracking"},
    "silhouettes": NOUNS | {"relative_pose", "tracking"},
    "hand_eye": NOUNS | {"sylvester"},
    "rig_calibration": NOUNS | ESTIMATORS | {"boards"},
    "atomic_io": set(),
    "serialization": {"geometry"},
    "report": NOUNS | FILES,
    "io": {""} | NOUNS | FILES | {"serialization", "boards", "report", "tracking", "landmarks", "features"},
    "simulate": NOUNS | FILES | {"io"},
    "sync": NOUNS | FILES | {"io", "tracking", "smoothing"},
    "experiments": NOUNS | {"packets", "sylvester", "simulate", "report"},
    "network": NOUNS | PARTS | FILES | {"packets", "serialization"} | (ESTIMATORS - {"bundle_adjustment"}),
    # Its results contain the version that made them.
    "archive": {""} | NOUNS | FILES | {"io", "sync", "report", "simulate", "runs"},
}
# Modules that import packages of others by their names.
IMPORT_OTHERS = {"runs.installation"}
# Where images are processed, read or written.
SEES_IMAGES = {
    "rig",
    "features",
    "boards",
    "silhouettes",
    "tracking.camera_side.frame",
    "sync",
    "io",
    "report",
    "simulate",
}


@cache
def modules() -> dict[str, Path]:
    """Return all modules by their names within the package; a folder's `__init__` has the folder's name, the package's
    has
    ""."""
    found = {}
    for path in sorted((SOURCE / "sylpose").rglob("*.py")):
        parts = path.relative_to(SOURCE / "sylpose").with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports(module: str) -> dict[str, bool]:
    """Return the full names that a module imports, also inside functions, and whether only for type checkers."""
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
    """Return the modules of the package that a module imports, with or without those for type annotations only."""
    for name, for_types in imports(module).items():
        first, _, rest = name.partition(".")
        if first == "sylpose" and (types or not for_types):
            yield rest if rest in modules() else rest.rpartition(".")[0]


def room_of(module: str) -> str:
    return module.partition(".")[0]


INNER = [m for m in modules() if m not in ("", "__main__") and room_of(m) not in ("runs", "browser", "commands")]


def test_every_package_has_a_layer() -> None:
    assert {room_of(m) for m in INNER} == set(ALLOWED)


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_packages_import_only_allowed_layers(room: str) -> None:
    wrong = [
        f"{module} imports {other or 'sylpose itself'}"
        for module in INNER
        if room_of(module) == room
        for other in imported_modules(module, types=True)
        if room_of(other) not in ALLOWED[room] | {room}
    ]
    assert not wrong


def test_no_estimator_reads_writes_or_simulates() -> None:
    """Follows from the table above, which must not be relaxed in this way."""
    for room in ESTIMATORS:
        assert not ALLOWED[room] & {
            "atomic_io",
            "io",
            "report",
            "sync",
            "simulate",
            "experiments",
            "runs",
            "commands",
            "archive",
        }


def test_few_packages_process_images() -> None:
    wrong = [
        module
        for module in modules()
        if any(name.partition(".")[0] in ("cv2", "av") for name in imports(module))
        and not {module, room_of(module)} & SEES_IMAGES
    ]
    assert not wrong


def test_no_import_cycles() -> None:
    """Neither between modules, including deferred imports, nor between packages."""
    of_modules = {m: set(imported_modules(m, types=True)) - {m} for m in modules() if m}
    of_rooms: dict[str, set[str]] = {}
    for module, others in of_modules.items():
        of_rooms.setdefault(room_of(module), set()).update({room_of(o) for o in others} - {room_of(module), ""})
    for graph in (of_modules, of_rooms):
        # The package's `__init__` imports the public names lazily; modules that import it need the version.
        kept = {module: others - {""} for module, others in graph.items()}
        try:
            TopologicalSorter(kept).prepare()
        except CycleError as error:
            pytest.fail(" -> ".join(error.args[1]))


def test_no_module_is_imported_by_a_string() -> None:
    """Such imports would escape the tests above; the package's own table of public names is the exception."""
    wrong = []
    for module, path in modules().items():
        text = path.read_text(encoding="utf-8")
        if "import_module" not in text and "__import__" not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.Call) or ast.unparse(node.func).rpartition(".")[2] not in (
                "import_module",
                "__import__",
            ):
                continue
            texts = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
            is_own = any(isinstance(text, str) and text.split(".")[0] in ("sylpose", "") for text in texts)
            if module and (is_own or module not in IMPORT_OTHERS):
                wrong.append(f"{module}: {ast.unparse(node)}")
    assert not wrong


def code_lines(path: Path) -> int:
    """Count the lines that have code: docstrings, comments and blank lines are free."""
    text = path.read_text(encoding="utf-8")
    documented: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            documented.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    ignored = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in ignored:
            used.update(range(token.start[0], token.end[0] + 1))
    return len(used - documented)


def test_no_module_is_too_long() -> None:
    long = {name: path for name, path in modules().items() if path.read_bytes().count(b"\n") > MAX_CODE_LINES}
    assert {name for name, path in long.items() if code_lines(path) > MAX_CODE_LINES} == set()
