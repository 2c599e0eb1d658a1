"""Limits on what is read of files, and the one sentence for whatever is wrong with one."""

from __future__ import annotations

import os
import time
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.input_limits import MAX_TEXT, SAID, Unreadable, bytes_of, one_line, parsed_toml, resolved, text_of, told


@given(st.text(max_size=2000), st.integers(20, SAID))
def test_one_line_is_one_printable_line_of_bounded_length(text: str, limit: int) -> None:
    line = one_line(text, limit)
    assert len(line) <= limit
    assert line.isprintable()
    assert line.splitlines() in ([line], [])


def test_one_line_keeps_what_is_plain() -> None:
    assert one_line("camera «ä» is カメラ, 5 px") == "camera «ä» is カメラ, 5 px"
    assert one_line("a\r\n\x1b[31mb") == "a \\x1b[31mb"
    assert one_line("begin " + "x" * 5000 + " end").startswith("begin x")
    assert one_line("begin " + "x" * 5000 + " end").endswith("x end")


@given(st.text(max_size=1000).filter(lambda s: bool(s.split())))
def test_told_names_the_file_once(said: str) -> None:
    for raised in (said, f"dir/a.toml: {said}"):
        with pytest.raises(Unreadable) as caught, told(Path("dir/a.toml")):
            raise ValueError(raised)
        message = str(caught.value)
        assert message.startswith("dir/a.toml: ")
        assert not message.startswith("dir/a.toml: dir/a.toml: ") or said.startswith("dir/a.toml")
        assert len(message) <= len("dir/a.toml") + SAID
        assert message.isprintable()


@pytest.mark.parametrize("error", [OverflowError("int too large"), RecursionError("depth"), MemoryError()])
def test_told_turns_what_parsers_raise_into_sentences(error: Exception) -> None:
    with pytest.raises(Unreadable, match=r"^a\.toml: \w"), told("a.toml"):
        raise error


def test_told_lets_pass_what_was_told_and_what_the_system_says() -> None:
    with pytest.raises(Unreadable, match=r"^a\.toml: wrong$"), told("folder"), told("a.toml"):
        raise ValueError("wrong")
    with pytest.raises(FileNotFoundError), told("folder"):
        Path("nowhere").stat()


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    with pytest.raises(Unreadable, match="a file is expected"):
        bytes_of(tmp_path)
    with pytest.raises(FileNotFoundError):
        bytes_of(tmp_path / "nothing")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(Unreadable, match=r"pipe: a file is expected, not a folder, a pipe or a device"):
            bytes_of(tmp_path / "pipe")
    if os.path.exists("/dev/zero"):
        with pytest.raises(Unreadable, match="a file is expected"):
            bytes_of(Path("/dev/zero"))


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_links_in_a_circle_are_said(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    resolved(tmp_path / "a")
    with pytest.raises(OSError, match="a"):
        bytes_of(tmp_path / "a")


def test_limits_of_size_digits_and_encoding(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_bytes(b"x" * MAX_TEXT)
    assert len(text_of(file)) == MAX_TEXT
    file.write_bytes(b"x" * (MAX_TEXT + 1))
    with pytest.raises(Unreadable, match=r"a\.toml: 1048577 bytes, more than"):
        text_of(file)
    file.write_text("a = " + "9" * 308)
    assert text_of(file)
    file.write_text("a = " + "9" * 309)
    with pytest.raises(Unreadable, match=r"a\.toml: a number of more than 308 digits"):
        text_of(file)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(Unreadable, match=r"a\.toml: not text in UTF-8"):
        text_of(file)
    file.write_bytes(b"\xef\xbb\xbfa = 1")
    assert text_of(file) == "a = 1"


@pytest.mark.parametrize(
    "text",
    [
        "a." * 20_000 + "a = 1",
        '"a b" . ' * 5000 + "a = 1",
        "x = {" + "1." * 9000 + "a = 1}",
        ("b." * 1000 + "c=1\n") * 40,
    ],
)
def test_keys_of_many_parts_cost_nothing(text: str) -> None:
    tracemalloc.start()
    begin = time.process_time()  # machines may be busy
    with pytest.raises(ValueError, match="too many dots"):
        parsed_toml(text)
    took, peak = time.process_time() - begin, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert took < 0.2
    assert peak < 1e7


def test_toml_of_people_is_read() -> None:
    row = f"[{', '.join(['0.125'] * 16)}]"
    text = "".join(f"[cameras.cam_{i}]\nmatrix = [{', '.join([row] * 3)}]\n# {'.' * 70}\n" for i in range(300))
    assert len(parsed_toml(text)["cameras"]) == 300
