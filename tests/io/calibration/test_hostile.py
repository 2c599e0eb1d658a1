"""Malicious calibration files give one sentence at once, whatever the format (SECURITY.md)."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from sylpose.input_limits import MAX_MESSAGE_LENGTH, UnreadableFileError
from sylpose.io import calibration
from sylpose.simulate import ring


def make_nested(name: str, n: int) -> str:
    """Return a file with n nesting levels."""
    return {
        "a.json": '{"a":' * n + "1" + "}" * n,
        "comment.json": '{"a": /* OpenCV */' + '{"a":' * n + "1" + "}" * (n + 1),
        "a.toml": "a = " + "[" * n + "]" * n,
        "a.yml": "a: " + "[" * n + "]" * n,
        "lines.yml": "a:\n " + "- " * n + "1",
        "take.xcp": "<Cameras>" + "<a>" * n + "</a>" * n + "</Cameras>",
        "a.xml": "<opencv_storage>" + "<a>" * n + "</a>" * n + "</opencv_storage>",
    }[name]


def load_error(path: Path, text: str) -> str:
    """Return the error sentence for a file with this text."""
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    begin = time.process_time()  # CPU time, independent of load
    with pytest.raises(UnreadableFileError) as caught:
        calibration.load(path)
    assert time.process_time() - begin < 1
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ")
    assert sentence.isprintable()
    assert len(sentence) <= len(str(path)) + MAX_MESSAGE_LENGTH
    return sentence


@pytest.mark.parametrize("depth", [900, 100_000])
@pytest.mark.parametrize("name", ["a.json", "comment.json", "a.toml", "a.yml", "lines.yml", "a.xml", "take.xcp"])
def test_deep_nesting_is_rejected(name: str, depth: int, tmp_path: Path) -> None:
    sentence = load_error(tmp_path / name, make_nested(name, depth))
    assert any(word in sentence for word in ("deep", "not a calibration", "allowed for TOML"))


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.yml", "cam_0: &x\n  K: 1\ncam_1: *x\n", "aliases"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage><a>&b;</a></opencv_storage>', "DOCTYPE"),
        ("take.xcp", '<!DOCTYPE a [<!ENTITY b "c">]><Cameras><Camera DEVICEID="&b;"/></Cameras>', "DOCTYPE"),
        ("a.json", '{"a": 1} /* without end', "not valid JSON"),
        ("a.json", '{"a": 1} /*/', "not valid JSON"),
        ("a.json", '{"a": 1} "without end \\\\', "not valid JSON"),
        ("a.toml", "a." * 20_000 + "a = 1", "dots"),
        ("a.toml", "a = " + "9" * 400, "308 digits"),
        ("a.yml", "cam_0:\n  K: { rows: .Inf, cols: 3, data: [1] }\n  D: [0]\n  size: [6, 4]\n", "rows, cols"),
    ],
)
def test_unsupported_content_is_rejected(name: str, text: str, what: str, tmp_path: Path) -> None:
    assert what in load_error(tmp_path / name, text)


@pytest.mark.parametrize("suffix", [".toml", ".json", ".yml"])
@pytest.mark.parametrize("name", ["", "..", "cam/_2", "..\\x", "a\x1b[2J", "a\0b", "a\ud800"])
def test_names_outside_the_recording_are_rejected(name: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    calibration.save(ring(2), path)
    text = path.read_text()
    quoted = json.dumps(name)
    for old in ('"cam_0"', "name: cam_0", "[cameras.cam_0"):
        text = text.replace(old, {'"': quoted, "n": f"name: {quoted}", "[": f"[cameras.{quoted}"}[old[0]])
    load_error(path, text)


def test_error_length_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    calibration.save(ring(2), path)
    text = path.read_text().replace('"lens": "opencv"', f'"lens": "x\\r\\n\\u001b[31m{"y" * 5000}"', 1)
    assert "is not known" not in load_error(path, text)  # the sentence is cut in the middle
