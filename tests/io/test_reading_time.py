"""Readers take time linear in a file's size, whatever fills it (SECURITY.md).

A regular expression whose `\\s*` crosses line ends takes quadratic time on empty lines, and one that searches the end of a
string from each quote on quotes: minutes for 100 kB.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from benchmarks.fuzz import SIZE, Kind, make_kinds
from benchmarks.fuzz_calibrations import SAMPLES, Sample
from sylpose.boards.specification import parse_board
from sylpose.input_limits import to_one_line
from sylpose.io import calibration
from sylpose.io.calibration.world import load_world, parse_up_world
from sylpose.io.capture.images import image_size_from_header
from sylpose.simulate import ring
from sylpose.units import parse_length

WHITE_SPACE = (" ", "\t", "\n", "\r", "\r\n", "\v", "\f", "\u00a0", "\u2028")
MARKS = ("9", "0", *"()[]{}<>", "'", '"', ",", ";", ":", "=", "-", "+", ".", "#", "\\", "_", "|", "&", "%")
MIXTURES = ("\n ", " \n", '\\"', "/*", "//", "- ", "1 ", "1,", "a\n", "\n\n1", "a: 1\n", "[]", "e+")
FILLERS = (*WHITE_SPACE, *MARKS, *MIXTURES)
# Those that have been quadratic for one reader, and one of each kind.
QUICK_FILLERS = (" ", "\n", "\r\n", "9", *"([{<", "'", '"', "\\", "\n ", " \n", '\\"', "/*", "a: 1\n")
# Bytes: 64 kB, for which quadratic time is a quarter of a minute; and 1 MB, of which TOML may have a quarter.
QUICK_BYTES, TOML_BYTES, BYTES = 2**16, 2**18 - 8, 2**20 - 8
# Largest processor time, seconds: several times what the slowest linear readers (YAML, CSV) need for 1 MB.
MAX_SECONDS = 5.0


def load_sample(file: Path, sample: Sample) -> object:
    """Load a calibration by its main file, another file of which is filled."""
    for name, content in {**sample.other_files, sample.name: sample.samples[0]}.items():
        if name != file.name:
            (file.parent / name).write_bytes(content)
    return calibration.load(file.with_name(sample.name), lambda names: dict.fromkeys(names, SIZE))


# The kinds of benchmarks/fuzz.py, files of MultiCamSelfCal that are not calibrations, names of any content, and worlds.
KINDS = {
    **{name: kind for name, kind in make_kinds().items() if kind.is_text and "manifest" not in name},
    **{
        f"{name}, {file}": Kind(file, (content,), partial(load_sample, sample=sample))
        for name, sample in SAMPLES.items()
        for file, content in sample.other_files.items()
        if name == "MultiCamSelfCal" and file in ("Res.dat", "camera_order.txt")
    },
    **{name: Kind(name, (b"",), calibration.load) for name in ("calibration", "cameras.txt", "a.rad", "a.pickle")},
    "world": Kind("world.toml", (b"origin = [0, 0, 0]\nx = [1, 0, 0]\n",), partial(load_world, rig=ring(3, size=SIZE))),
    "image": Kind("a.ppm", (b"P6\n", b"\xff\xd8"), lambda file: image_size_from_header(file.read_bytes())),
}


def measure(kind: Kind, file: Path, data: bytes) -> float:
    """Return the processor time of reading a file, which may be refused in a sentence; machines may be busy."""
    file.write_bytes(data)
    begin = time.process_time()
    with suppress(ValueError, OSError):
        kind.read(file)
    return time.process_time() - begin


def check(kind: Kind, folder: Path, fillers: Sequence[str], size: int, within: bool) -> None:
    """Read each filler after a valid file and alone, and within the file."""
    file, sample = folder / kind.name, kind.samples[0]
    middle = sample.rfind(b"\n", 0, len(sample) // 2) + 1
    for filler in fillers:
        for before, after in ((sample, b""), (b"", b""), *([(sample[:middle], sample[middle:])] if within else [])):
            count = (size - len(before) - len(after)) // len(filler.encode())
            seconds = measure(kind, file, before + filler.encode() * count + after)
            assert seconds < MAX_SECONDS, f"{filler!r} after {before[-20:]!r}"


@pytest.mark.parametrize("name", KINDS)
def test_reading_time_is_linear(name: str, tmp_path: Path) -> None:
    check(KINDS[name], tmp_path, QUICK_FILLERS, QUICK_BYTES, within=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_reading_time_is_linear_up_to_a_megabyte(name: str, tmp_path: Path) -> None:
    check(KINDS[name], tmp_path, FILLERS, TOML_BYTES if KINDS[name].name.endswith(".toml") else BYTES, within=True)


@pytest.mark.parametrize("size", [QUICK_BYTES, pytest.param(BYTES, marks=pytest.mark.slow)])
@pytest.mark.parametrize("filler", FILLERS)
def test_parsing_time_of_options_is_linear(filler: str, size: int) -> None:
    for before in ("", "up=", "up=1,2,3", "up=-y origin=", "4", "4x", "chessboard:9x6", "chessboard:9x6,square="):
        for after in ("", "x"):
            text = before + filler * (size // len(filler)) + after
            begin = time.process_time()
            for parse in (parse_up_world, parse_board, partial(parse_length, name="size", unit="m"), to_one_line):
                with suppress(ValueError):
                    parse(text)
            assert time.process_time() - begin < 1.0, f"{filler!r} between {before!r} and {after!r}"
