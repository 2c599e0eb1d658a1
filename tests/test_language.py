"""Names, docstrings, comments, messages and documents use the field's terms, and standard terms lead to code."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.paths import REPOSITORY

PACKAGE = REPOSITORY / "src" / "sylpose"
SOURCES = sorted(PACKAGE.rglob("*.py"))
DOCUMENTS = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")])

# Cameras, frames and files do none of this, and their readers find the standard terms instead.
WORDS = [
    "tell",
    "tells",
    "told",
    "telling",
    "say",
    "says",
    "said",
    "saying",
    "ask",
    "asks",
    "asked",
    "asking",
    "hear",
    "hears",
    "heard",
    "whom",
    "whoever",
    "anew",
    "nobody",
    "somebody",
    "beside",
    "starve",
    "starves",
    "starved",
    "doubt",
    "doubts",
    "doubted",
    "aloud",
]
IN_TEXT = re.compile(rf"(?<![\w-])({'|'.join(WORDS)})(?![\w-])", re.IGNORECASE)
IN_NAMES = re.compile(rf"(?:^|_)({'|'.join(WORDS)})(?:_|$)")
HISTORY = REPOSITORY / "docs" / "history"

# What an engineer of the field searches for: each must be part of the name of a file, function or class.
TERMS = {
    "RANSAC": r"ransac",
    "P3P": r"p3p",
    "bundle adjustment": r"bundle_adjust",
    "extrinsics": r"extrinsic",
    "intrinsics": r"intrinsic",
    "Schur complement": r"schur",
    "relocalization": r"relocali[sz]",
    "robust loss": r"robust|cauchy|huber|irls",
    "triangulation": r"triangulat",
    "keyframe": r"keyframe",
    "reprojection error": r"reprojection",
    "epipolar": r"epipolar",
    "relative pose": r"relative_pose",
    "absolute pose": r"absolute_pose",
    "covariance": r"covariance",
    "observability": r"observab",
    "certificate": r"certif",
    "distortion": r"distort",
    "Sylvester equation": r"sylvester",
    "Lucas-Kanade": r"klt|lucas",
    "SIFT": r"sift",
    "background model": r"background",
    "time offset": r"time_offset",
    "synchronization": r"sync",
    "checkpoint": r"checkpoint",
    "message format": r"wire_format|codec|serializ",
    "gossip": r"gossip",
    "byzantine": r"byzantine",
    "motion model": r"motion_model",
    "state machine": r"state_machine",
    "initialization": r"initialization",
    "smoothing": r"smooth",
    "scale prior": r"scale_prior",
    "outlier": r"outlier",
    "inlier": r"inlier",
    "residual": r"residual",
    "Jacobian": r"jacobian",
    "landmark": r"landmark",
    "trajectory": r"trajectory",
    "camera motion": r"camera_motion",
    "calibration": r"calibrat",
    "undistortion": r"undistort",
    "rotation averaging": r"average_rotation|rotation_averag|average",
    "lens": r"lens",
    "AprilTag": r"apriltag|tags?_|board",
}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def names_of(path: Path) -> Iterator[tuple[int, str]]:
    """Line and name of every function, class, parameter, field and module constant."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                if isinstance(target, ast.Name):
                    yield node.lineno, target.id
                elif isinstance(target, ast.Attribute):
                    yield node.lineno, target.attr


def without_code(text: str) -> str:
    """Blank out literals in backticks and fenced blocks, keeping lines."""
    text = re.sub(r"(?ms)^```.*?^```", lambda m: "\n" * m[0].count("\n"), text)
    return re.sub(r"`[^`\n]*`", "", text)


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring, message and comment."""
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(parsed(path)):
        # A string without a blank is a key, a file's name or a pattern.
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value.strip():
            yield node.lineno, node.value


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_names_and_texts_of_the_code(path: Path) -> None:
    found = [f"{line}: {name}" for line, name in names_of(path) if IN_NAMES.search(_snake(name))]
    for line, text in texts_of(path):
        found += [f"{line}: {m[0]} in {text.strip()[:80]!r}" for m in IN_TEXT.finditer(without_code(text))]
    assert not found


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_words_of_documents(path: Path) -> None:
    if HISTORY in path.parents:
        return
    lines = without_code(path.read_text(encoding="utf-8")).splitlines()
    assert not [
        f"{k}: {m[0]} in {line.strip()[:80]!r}" for k, line in enumerate(lines, 1) for m in IN_TEXT.finditer(line)
    ]


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


@cache
def all_names() -> list[str]:
    """Files, functions and classes."""
    names = [path.stem if path.stem != "__init__" else path.parent.name for path in SOURCES]
    names += [path.parent.name for path in SOURCES]
    for path in SOURCES:
        names += [n.name for n in ast.walk(parsed(path)) if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    return [_snake(name) for name in names]


@pytest.mark.parametrize("term", TERMS)
def test_standard_term_leads_to_code(term: str) -> None:
    assert any(re.search(TERMS[term], name) for name in all_names())


def test_word_list_finds_words() -> None:
    assert IN_TEXT.search("what it says of cameras")
    assert IN_NAMES.search(_snake("ToldByMatches"))
    assert not IN_TEXT.search("essays, besides, task")
    assert not IN_NAMES.search("task_assaying_nothing")
