"""Documents: the files, figures, sections and names that they mention exist; their Python and commands run."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import typer

import sylpose
from sylpose.commands.app import app
from sylpose.commands.main import main
from sylpose.simulate import dome, ellipsoid, random_motion, simulate_matches
from sylpose.status import Status
from tests.conftest import make_once
from tests.paths import REPOSITORY
from tests.saved import write_turn_recording

PACKAGE = REPOSITORY / "src" / "sylpose"
PAGES = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")])
EVERY_NAME = sorted(page.relative_to(REPOSITORY).as_posix() for page in PAGES)
# Pages of the history keep the names of their time; only their links are checked.
NAMES = [name for name in EVERY_NAME if not name.startswith("docs/history/")]
# Marker line above Python blocks that tests cannot run.
NOT_RUN, MOST_NOT_RUN = "<!-- not run: ", 1


@cache
def text_of(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def prose_of(name: str) -> str:
    """Return a page without code blocks."""
    return re.sub(r"(?ms)^```.*?^```$", "", text_of(name))


@cache
def anchors_of(name: str) -> set[str]:
    """Return the anchors that GitHub makes from headings."""
    headings = re.findall(r"(?m)^#+ (.*)$", prose_of(name))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


class Block(NamedTuple):
    """A fenced block: its language, first line number, lines, and the line above it."""

    page: str
    language: str
    line: int
    lines: list[str]
    above: str

    @property
    def name(self) -> str:
        return f"{self.page}:{self.line}"


def blocks() -> Iterator[Block]:
    for page in NAMES:
        lines = text_of(page).splitlines()
        fences = [i for i, line in enumerate(lines) if line.startswith("```")]
        assert len(fences) % 2 == 0, page
        for i, j in zip(fences[::2], fences[1::2], strict=True):
            above = next((line for line in reversed(lines[:i]) if line), "")
            yield Block(page, lines[i][3:], i + 1, lines[i + 1 : j], above)


# --- files, figures, sections, names ---------------------------------------------------------------------------------


@pytest.mark.parametrize("page", EVERY_NAME)
def test_links_and_figures_exist(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose_of(page)):
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        path = ((REPOSITORY / page).parent / file).resolve() if file else REPOSITORY / page
        assert path.exists(), target
        if anchor:
            assert anchor in anchors_of(path.relative_to(REPOSITORY).as_posix()), target


def test_every_figure_is_shown() -> None:
    shown = {
        Path(target).name for page in EVERY_NAME for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text_of(page))
    }
    assert {path.name for path in (REPOSITORY / "docs" / "images").iterdir()} == shown


def file_of(name: str) -> Path | None:
    """Return a file of the package or of the repository."""
    return next((path for path in (PACKAGE / name, REPOSITORY / name) if path.is_file()), None)


@cache
def defined_in(path: Path) -> set[str]:
    """Return the names of functions, classes, methods and constants."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    names = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    return names | {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}


@pytest.mark.parametrize("page", NAMES)
def test_mentioned_modules_exist(page: str) -> None:
    """`rig.py`, `sylvester/equation.py`, `benchmarks/nees.py`; and `file.py` (`name`, `other`) defines these names."""
    for name in re.findall(r"`([\w./]+\.(?:py|json|toml|md|cff))`", prose_of(page)):
        if name.endswith(".py") and not name.startswith("../") and not name.startswith("NAME") and "/NAME" not in name:
            assert file_of(name), name
    for name, inside in re.findall(r"`([\w/]+\.py)`\s\(((?:`\w+`(?:,\s)?)+)\)", prose_of(page)):
        path = file_of(name)
        assert path is not None
        for wanted in re.findall(r"`(\w+)`", inside):
            assert wanted in defined_in(path), f"{wanted} of {name}"


def test_mentioned_constants_have_these_values() -> None:
    """`INDEPENDENT = 6` of `relative_pose/irls.py`; for the table in docs/map.md see tests/test_map.py."""
    text = 0
    for page in NAMES:
        for name, value, file in re.findall(r"`([A-Z_]+) = ([\d.e-]+)`\s+of\s+`([\w/]+)\.py`", prose_of(page)):
            module = import_module(f"sylpose.{file.replace('/', '.')}")
            assert getattr(module, name) == pytest.approx(float(value)), f"{page}: {name}"
            text += 1
    assert text > 0


@pytest.mark.parametrize("page", NAMES)
def test_mentioned_python_names_exist(page: str) -> None:
    """`sylpose.simulate`, `sylpose.sylvester.equation.solve_sylvester`."""
    if page == "CHANGELOG.md":  # also describes earlier versions
        return
    for dotted in re.findall(r"`(sylpose(?:\.\w+)+)`", prose_of(page)):
        found: Any = sylpose
        so_far = "sylpose"
        for part in dotted.split(".")[1:]:
            so_far += f".{part}"
            found = getattr(found, part) if hasattr(found, part) else import_module(so_far)


def test_sections_mentioned_in_code_exist() -> None:
    """docs/method/2-sylvester.md, "The paper"; docs/formats.md#boxestoml."""
    text = 0
    for folder in ("src", "tests", "benchmarks", "examples"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            words = re.sub(r"\s*\n[\s#]*", " ", path.read_text(encoding="utf-8"))
            for page, title, anchor in re.findall(r'\b(docs/[\w/-]+\.md)(?:, "([^"]+)"|#([\w-]+))?', words):
                text += 1
                assert page in EVERY_NAME, f"{path}: {page}"
                if title or anchor:
                    wanted = anchor or re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
                    assert wanted in anchors_of(page), f"{path}: {page}, {title or anchor}"
    assert text > 20


def test_toml_and_json_are_valid() -> None:
    read = {"toml": tomllib.loads, "json": json.loads}
    found = [block for block in blocks() if block.language in read]
    assert len(found) > 10
    for block in found:
        try:
            read[block.language]("\n".join(block.lines))
        except ValueError as error:
            pytest.fail(f"{block.name}: {error}")


@pytest.fixture
def session(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> Path:
    """Return a writable copy of the first frames of `recording`: examples must run, their results are not shown."""
    few = make_once(tmp_path_factory, "few_frames", lambda folder: write_turn_recording(folder, 6))
    return Path(shutil.copytree(few, tmp_path / "session"))


# --- Python ----------------------------------------------------------------------------------------------------------


def _matches() -> dict[str, Any]:
    rig, rng = dome(4), np.random.default_rng(1)
    pair = simulate_matches(rig, ellipsoid((0.15, 0.12, 0.10)), random_motion(10.0, 0.02, rng), rng=rng)
    return {"rig": rig, "matches": pair.matches}


def _pixels() -> dict[str, Any]:
    rig, matches = _matches().values()
    pixels = [(camera.denormalize(m.x), camera.denormalize(m.y)) for camera, m in zip(rig, matches, strict=True)]
    return {"rig": rig, "pixels": pixels}


def _known_points() -> dict[str, Any]:
    rig = dome(4)
    points = np.random.default_rng(3).uniform(-0.1, 0.1, (20, 3))
    return {"rig": rig, "points": [points] * len(rig), "pixels": [camera.project(points) for camera in rig]}


def _matrices() -> dict[str, Any]:
    rng = np.random.default_rng(4)
    return {name: rng.normal(size=(3, 3)) for name in ("A", "B", "C", "A1", "A2", "B1", "B2")}


def _images() -> dict[str, Any]:
    frames = list(sylpose.open_session("recording").frames())
    return {"times": [frame.time for frame in frames], "images": [frame.images for frame in frames]}


def _labels() -> dict[str, Any]:
    """Write labels into the folder that the block runs in."""
    for folder in ("labels/cam_0", "masks/mug/cam_0"):
        Path(folder).mkdir(parents=True)
    cv2.imwrite("labels/cam_0/0017.png", np.ones((4, 6), np.uint8))
    return {}


# Names that a block assumes, by the words that identify it.
GIVEN: dict[str, Callable[[], dict[str, Any]]] = {
    "from sylpose import Matches, estimate_motion": _pixels,
    "from sylpose import FrameSet": _images,
    "from sylpose import estimate_pose": _known_points,
    "from sylpose import PairMoments, solve_centralized": _matches,
    "from sylpose import solve_generalized_sylvester": _matrices,
    "import cv2": _labels,
}
PYTHON = [block for block in blocks() if block.language == "python"]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("block", PYTHON, ids=[block.name for block in PYTHON])
def test_python_runs(block: Block, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each block in a folder with a recording, with the names that it assumes."""
    code = compile("\n" * block.line + "\n".join(block.lines), block.page, "exec")
    namespace: dict[str, Any] = {}
    if block.above.startswith(NOT_RUN):
        imports = [line for line in block.lines if line.startswith(("import ", "from "))]
        exec("\n".join(imports), namespace)
        return
    monkeypatch.chdir(session.rename(session.parent / "recording").parent)
    monkeypatch.setattr("sylpose.sync.estimation.MAX_ROUNDS", 1)  # checks that it runs, not its accuracy
    for start, given in GIVEN.items():
        if block.lines[0].startswith(start):
            namespace |= given()
    exec(code, namespace)
    for name in ("motion", "pose", "solution"):
        assert getattr(namespace.get(name), "status", Status.OK).has_pose


def test_most_python_is_run() -> None:
    assert len(PYTHON) >= 8
    assert sum(block.above.startswith(NOT_RUN) for block in PYTHON) <= MOST_NOT_RUN


# --- commands --------------------------------------------------------------------------------------------------------


def commands(start: str) -> list[tuple[str, list[str]]]:
    """Return command lines in blocks: page and words, without comments."""
    return [
        (page, shlex.split(line, comments=True)[1:])
        for page in NAMES
        for line in re.findall(rf"(?m)^(?: {{4}})?{start} .*$", text_of(page))
        if " " in line and not re.match(rf"{start} (?:finds|reads|tells)", line)
    ]


def parse(words: list[str]) -> None:
    """Parse a command line without executing it.

    Raises:
        click's UsageError: no such command or option, or an invalid value.
    """
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        assert words[0] in command.commands, words
        command, words = command.commands[words[0]], words[1:]
    command.make_context(command.name, list(words))


SYLPOSE = commands("sylpose")


@pytest.mark.parametrize(("page", "words"), SYLPOSE, ids=[f"{page}-{' '.join(words)}" for page, words in SYLPOSE])
def test_commands_are_valid(page: str, words: list[str]) -> None:
    assert page
    parse(words)


def test_examples_in_help_are_valid() -> None:
    def all_of(command: Any) -> Iterator[Any]:
        yield command
        for inner in getattr(command, "commands", {}).values():
            yield from all_of(inner)

    lines = [
        shlex.split(line)[1:]
        for command in all_of(typer.main.get_command(app))
        for line in (command.epilog or "").splitlines()
        if line.startswith("  sylpose ")
    ]
    assert len(lines) > 12
    for words in lines:
        parse(words)


def test_commands_in_sentences_exist() -> None:
    """`sylpose track SESSION --resume`, and `--options` alone."""
    root: Any = typer.main.get_command(app)
    every = [*root.commands.values(), *(c for g in root.commands.values() for c in getattr(g, "commands", {}).values())]
    known = {name for command in (root, *every) for p in command.params for name in (*p.opts, *p.secondary_opts)}
    known |= {"--help"}
    for page in NAMES:
        for sentence in re.findall(r"`sylpose ([^`]+)`", prose_of(page)):
            words = sentence.split()
            assert words[0] in root.commands or words[0] in known, f"{page}: {sentence}"
            assert {word for word in words if word.startswith("--")} <= known, f"{page}: {sentence}"
        for option in re.findall(r"`(--[\w-]+)[^`]*`", prose_of(page)):
            assert option in known | BENCHMARK_OPTIONS, f"{page}: {option}"


@cache
def options_of(script: Path) -> set[str]:
    """Return the options of a script's `argparse`."""
    found = re.findall(r'"--([\w-]+)"(.*)', script.read_text(encoding="utf-8"))
    return {f"--{no}{name}" for name, rest in found for no in ("", *["no-"] * ("BooleanOptional" in rest))}


BENCHMARK_OPTIONS = {option for path in (REPOSITORY / "benchmarks").glob("*.py") for option in options_of(path)}


def test_scripts_and_their_options_exist() -> None:
    """`python benchmarks/nees.py --scenes 500`, in documents and in the benchmarks' docstrings."""
    text = commands("python")
    for path in (REPOSITORY / "benchmarks").glob("*.py"):
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        lines = re.sub(r"\s*\n {10,}", " ", docstring)
        text += [(path.name, re.split(r"[\s\[\]|]+", line)) for line in re.findall(r"(?m)^ +python (\S.*)$", lines)]
    assert len(text) > 20
    for page, (script, *words) in text:
        if script.startswith("../"):  # next to the project
            continue
        if script == "-m":
            script = f"src/{words[0].replace('.', '/')}.py"
        options = {word for word in words if word.startswith("--")} - {"--help"}
        assert options <= options_of(REPOSITORY / script), f"{page}: {script} {words}"


def test_benchmarks_document_their_commands() -> None:
    for path in (REPOSITORY / "benchmarks").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        if "__main__" in text:
            assert f"\n    python benchmarks/{path.name}" in (ast.get_docstring(ast.parse(text), clean=False) or ""), (
                path
            )


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"(?m)^([\w-]+):", text_of("Makefile")))
    for page, (target, *_) in commands("make"):
        assert target in targets, page
    for page in NAMES:
        for target in re.findall(r"`make ([\w-]+)`", prose_of(page)):
            assert target in targets, page


@pytest.mark.usefixtures("undrawn")
def test_getting_started_commands_run(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """README's own-videos commands and the conversions, one after the other, on a recording."""
    monkeypatch.chdir(session.rename(session.parent / "recording").parent)
    shutil.copy("recording/calibration.toml", "camera_array.toml")
    ran = [words for page, words in SYLPOSE if page in ("README.md", "docs/formats.md")]
    assert len(ran) >= 6
    for words in ran:
        assert main(words) == 0, (words, capsys.readouterr())
    assert Path("recording/sylpose/view_cam_2.csv").exists()
