"""Limits of input files, and the one-line messages about them."""

from __future__ import annotations

import os
import time
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sylpose.input_limits import (
    MAX_MESSAGE_LENGTH,
    MAX_TEXT_BYTES,
    UnreadableFileError,
    input_errors,
    parse_toml,
    read_bytes,
    read_text,
    resolve_path,
    to_one_line,
)


@given(st.text(max_size=2000), st.integers(20, MAX_MESSAGE_LENGTH))
def test_one_line_is_one_printable_line_of_bounded_length(text: str, limit: int) -> None:
    line = to_one_line(text, limit)
    assert len(line) <= limit
    assert line.isprintable()
    assert line.splitlines() in ([line], [])


def test_one_line_keeps_plain_text() -> None:
    assert to_one_line("camera «ä» is カメラ, 5 px") == "camera «ä» is カメラ, 5 px"
    assert to_one_line("a\r\n\x1b[31mb") == "a \\x1b[31mb"
    assert to_one_line("begin " + "x" * 5000 + " end").startswith("begin x")
    assert to_one_line("begin " + "x" * 5000 + " end").endswith("x end")


@given(st.text(max_size=1000).filter(lambda s: bool(s.split())))
def test_input_errors_name_the_file_once(said: str) -> None:
    for raised in (said, f"dir/a.toml: {said}"):
        with pytest.raises(UnreadableFileError) as caught, input_errors(Path("dir/a.toml")):
            raise ValueError(raised)
        message = str(caught.value)
        assert message.startswith("dir/a.toml: ")
        assert not message.startswith("dir/a.toml: dir/a.toml: ") or said.startswith("dir/a.toml")
        assert len(message) <= len("dir/a.toml") + MAX_MESSAGE_LENGTH
        assert message.isprintable()


@pytest.mark.parametrize("error", [OverflowError("int too large"), RecursionError("depth"), MemoryError()])
def test_input_errors_convert_parser_errors(error: Exception) -> None:
    with pytest.raises(UnreadableFileError, match=r"^a\.toml: \w"), input_errors("a.toml"):
        raise error


def test_input_errors_pass_converted_and_os_errors() -> None:
    with pytest.raises(UnreadableFileError, match=r"^a\.toml: wrong$"), input_errors("folder"), input_errors("a.toml"):
        raise ValueError("wrong")
    with pytest.raises(FileNotFoundError), input_errors("folder"):
        Path("nowhere").stat()


def test_special_files_do_not_block(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFileError, match="a file is expected"):
        read_bytes(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_bytes(tmp_path / "nothing")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(UnreadableFileError, match=r"pipe: a file is expected, not a folder, a pipe or a device"):
            read_bytes(tmp_path / "pipe")
    if os.path.exists("/dev/zero"):
        with pytest.raises(UnreadableFileError, match="a file is expected"):
            read_bytes(Path("/dev/zero"))


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_circular_links_are_reported(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    resolve_path(tmp_path / "a")
    with pytest.raises(OSError, match="a"):
        read_bytes(tmp_path / "a")


def test_limits_of_size_digits_and_encoding(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_bytes(b"x" * MAX_TEXT_BYTES)
    assert len(read_text(file)) == MAX_TEXT_BYTES
    file.write_bytes(b"x" * (MAX_TEXT_BYTES + 1))
    with pytest.raises(UnreadableFileError, match=r"a\.toml: 1048577 bytes, more than"):
        read_text(file)
    file.write_text("a = " + "9" * 308)
    assert read_text(file)
    file.write_text("a = " + "9" * 309)
    with pytest.raises(UnreadableFileError, match=r"a\.toml: it has a number of more than 308 digits"):
        read_text(file)
    file.write_bytes(b"\xff\xfea")
    with pytest.raises(UnreadableFileError, match=r"a\.toml: not text in UTF-8"):
        read_text(file)
    file.write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_text(file) == "a = 1"
    for encoding in ("utf-16-le", "utf-16-be"):  # as PowerShell and spreadsheets write tables
        file.write_bytes("\ufeffa = 1".encode(encoding))
        assert read_text(file) == "a = 1"


@pytest.mark.parametrize(
    "text",
    [
        "a." * 20_000 + "a = 1",
        '"a b" . ' * 5000 + "a = 1",
        "x = {" + "1." * 9000 + "a = 1}",
        ("b." * 1000 + "c=1\n") * 40,
    ],
)
def test_keys_of_many_parts_are_rejected_quickly(text: str) -> None:
    tracemalloc.start()
    begin = time.process_time()  # with margin for busy machines
    with pytest.raises(ValueError, match="too many dots"):
        parse_toml(text)
    took, peak = time.process_time() - begin, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert took < 0.2
    assert peak < 1e7


def test_handwritten_toml_is_read() -> None:
    row = f"[{', '.join(['0.125'] * 16)}]"
    text = "".join(f"[cameras.cam_{i}]\nmatrix = [{', '.join([row] * 3)}]\n# {'.' * 70}\n" for i in range(300))
    assert len(parse_toml(text)["cameras"]) == 300
