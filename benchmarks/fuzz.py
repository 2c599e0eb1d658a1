"""Every reader of files, and of what nodes say to each other, against damaged and hostile ones: a result or one sentence,
at once and in little memory.

    python benchmarks/fuzz.py [--cases N] [--seed S] [--only KIND ...]

Files of every kind that is read (calibrations, settings, tables, images; tracks and checkpoints, with checksums that fit,
so that what is behind them is reached) and messages of nodes are changed at random, seeded: bytes, lines and numbers
replaced, cut, repeated, nested, joined with those of another file. Each is read. Allowed is a result, or an error that is a
`ValueError` or `OSError` of one printable line with the file's name in it (messages have none), of at most `SENTENCE`
characters, in less than `SECONDS` and `MEGABYTES`. Batches run in processes of their own, so that one that ends by a signal
is seen: its case is counted as a crash, and the rest of the batch goes on. Prints a line for each kind, and cases that are
not allowed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.fuzz_calibrations import SAMPLES, Sample
from sylpose import __version__, calibration
from sylpose.app.checkpoint import CHECKPOINT, FORMAT, load_checkpoint
from sylpose.app.checkpoint_schema import FUNCTIONS, KINDS, OutputState, RunState
from sylpose.app.frame_store import _FRAME, FrameFile
from sylpose.app.pixel_files import load_pixels
from sylpose.app.point_files import load_points
from sylpose.app.serialization import encoded
from sylpose.archive.recordings import Options, find_recordings
from sylpose.capture.boxes import load_boxes
from sylpose.capture.images import image_size, read_image
from sylpose.capture.live import open_live
from sylpose.capture.timeline import load_timestamps
from sylpose.frames import Box, FrameSet
from sylpose.input_limits import SAID
from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.messages import Judges, Says
from sylpose.moments import PairMoments
from sylpose.network.codec import packed, unpacked
from sylpose.network.frame_announcement import Roll
from sylpose.network.plausibility import objection
from sylpose.network.wire_format import (
    GIVES_UP,
    TELLS,
    Hello,
    Welcome,
    message,
    passed_on,
    read_hello,
    read_welcome,
    read_word,
    said_hello,
    welcomed,
)
from sylpose.relative_pose.terms import TermData
from sylpose.report.files import TrajectoryWriter, read_trajectory, read_tum
from sylpose.results import FramePose, FrameStatus
from sylpose.rig import Rig
from sylpose.simulate import ring
from sylpose.smoothing.trajectory import Track
from sylpose.sylvester.distributed.fault_decision import plausible
from sylpose.sylvester.distributed.messages import Message, decode, encode
from sylpose.sync.offsets import load_offsets
from sylpose.tracking.reports import Following, Known, Moved, Recognised, Seen
from sylpose.tracking.tracker import Tracker

ALLOWED = ("result", "sentence")
SECONDS, MEGABYTES = 0.2, 100.0
# One sentence may hold what is said of two files, one in the other's folder.
SENTENCE = 2 * SAID
SIZE = (64, 48)
BATCH = 1000
# Bytes of a case: above what calibrations and settings may have; of tables, which may be large, for the time.
LARGEST, LARGEST_TABLE = 1_200_000, 200_000
TABLES = (
    *("manifest", "manifest, csv", "time stamps", "trajectory.csv", "trajectory.tum"),
    *("points, csv", "points, ply", "points, binary", "points, obj", "pixels", "deeplabcut"),
)
RIG: Rig = ring(3, size=SIZE)
IMAGES = (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm", ".jp2")
# What numbers, words and values are replaced by.
TOKENS = (
    *("0", "-1", "1e308", "-1e308", "1e309", "1e30", "nan", ".NaN", "inf", ".Inf", "-inf", "9" * 20, "9" * 400, "0x7f"),
    *(
        "true",
        "null",
        '""',
        '"',
        "'",
        "[",
        "]",
        "{",
        "}",
        "[[",
        "[]",
        "{}",
        "<",
        ">",
        "</",
        "<_>",
        "&amp;",
        "<!DOCTYPE x>",
    ),
    *(
        "#",
        "=",
        ":",
        ",",
        "- ",
        "---",
        "...",
        "*a",
        "&a ",
        "!!binary ",
        "%YAML:1.0\n",
        "|",
        "\\",
        "\\u0000",
        "\\ud800",
        "..",
    ),
    *(
        "\n",
        "\r",
        "\t",
        "\0",
        "\x1b[2J",
        "\u202e",
        "\u2028",
        "é",
        "😀",
        "../../etc",
        "cam_0",
        "size",
        "rotation",
        "cameras",
    ),
)


class Kind(NamedTuple):
    """A kind of file: its name on the disk, whole ones of it, what reads it; whether it is text, and whether what is said of
    it names it."""

    name: str
    whole: tuple[bytes, ...]
    read: Callable[[Path], object]
    text: bool = True
    named: bool = True


@cache
def kinds() -> dict[str, Kind]:
    """By name."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        saved = {
            s: [_saved(rig, folder / f"a{s}") for rig in (RIG, ring(1))] for s in (".toml", ".yml", ".json", ".xml")
        }
        table, tum = _trajectory(folder)
    load = calibration.load
    found = {
        "sylpose": Kind("calibration.toml", tuple(saved[".toml"]), load),
        "anipose": Kind("calibration.toml", (ANIPOSE, *saved[".toml"]), load),
        "caliscope": Kind("camera_array.toml", (CALISCOPE, ANIPOSE), load),
        "yaml": Kind("calibration.yml", (*saved[".yml"], BY_HAND), load),
        "json": Kind("calibration.json", (*saved[".json"], MULTICAL), load),
        "xml": Kind("calibration.xml", tuple(saved[".xml"]), load),
        "boxes": Kind("boxes.toml", (BOXES, SEVERAL), partial(load_boxes, rig=RIG)),
        "offsets": Kind("offsets.toml", (OFFSETS,), partial(load_offsets, cameras=RIG.names)),
        "live": Kind("live.toml", (LIVE,), _live),
        "manifest": Kind("manifest.toml", (MANIFEST,), _manifest),
        "manifest, csv": Kind("manifest.csv", (LISTED,), _manifest),
        "time stamps": Kind("timestamps.csv", (STAMPS,), partial(load_timestamps, cameras=RIG.names)),
        "trajectory.csv": Kind("trajectory.csv", (table,), read_trajectory),
        "trajectory.tum": Kind("trajectory.tum", (tum,), read_tum),
        "points, csv": Kind("points.csv", (POINTS,), load_points),
        "points, toml": Kind("points.toml", (NAMED, MARKERS), load_points),
        "points, ply": Kind("points.ply", (PLY,), load_points),
        "points, binary": Kind("points.ply", (PLY_BINARY,), load_points, text=False),
        "points, obj": Kind("points.obj", (OBJ,), load_points),
        "pixels": Kind("pixels.csv", (PIXELS,), _pixels),
        "deeplabcut": Kind("cam_0DLC.csv", (DEEPLABCUT,), _pixels),
    }
    for name, sample in SAMPLES.items():
        found[name] = Kind(sample.name, sample.whole, partial(_with_others, sample=sample), sample.text)
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8), np.zeros((SIZE[1], SIZE[0], 3), np.uint8)]
    for suffix in IMAGES:
        whole = tuple(bytes(cv2.imencode(suffix, picture)[1]) for picture in pictures)
        found[suffix[1:]] = Kind(f"0000{suffix}", whole, _image, text=False)
    track, state = _tracked()
    found["tracks.bin"] = Kind("content.bin", (_content(track, {}),), _tracks, text=False)
    found["checkpoint"] = Kind("content.bin", (_content(state, FUNCTIONS),), _checkpoint, text=False)
    told = [packed(one) for one in TOLD]
    number = Hello(2, 7), Welcome(5, 9, frozenset({0, 1}), told[0])
    words = [message(TELLS, 1, 5, 9, told[0]), welcomed(1, number[1]), said_hello(1, 9, number[0])]
    words.append(passed_on(GIVES_UP, 1, 5, 9, frozenset({2}), frozenset({0}), {0: told[1], 2: told[2]}))
    x = np.random.default_rng(0).uniform(-0.2, 0.2, (2, 30, 2))
    values = np.frombuffer(PairMoments.from_matches(*x).to_bytes(), "<f8")
    found["message"] = Kind("message", tuple(told), _message, text=False, named=False)
    found["word"] = Kind("word", tuple(words), _word, text=False, named=False)
    plain = (encode(1, Message(3, True, False, values)),)
    found["moments"] = Kind("moments", plain, _moments, text=False, named=False)
    return found


def case(kind: str, seed: int) -> bytes:
    """One changed file."""
    rng = np.random.default_rng([seed, *kind.encode()])
    whole = kinds()[kind].whole
    data = whole[rng.integers(len(whole))]
    text = kinds()[kind].text
    for _ in range(1 + rng.poisson(1.5)):
        data = _changed_text(rng, data, whole) if text and rng.random() < 0.8 else _changed_bytes(rng, data, whole)
        data = data[: LARGEST_TABLE if kind in TABLES else max(LARGEST, 2 * len(whole[0]))]
    return data


class Verdict(NamedTuple):
    """What comes of reading a file: "result", "sentence", or a word for what is not allowed; what was said; seconds."""

    word: str
    said: str
    took: float


def verdict(kind: Kind, file: Path) -> Verdict:
    """Of reading this file."""
    begin = time.perf_counter()
    try:
        kind.read(file)
        word, said = "result", ""
    except (ValueError, OSError) as error:
        word, said = "sentence", str(error)
        # Pickles may name what they want of NumPy.
        if type(error).__name__ == "LinAlgError" or ("numpy" in said and "a pickle that wants" not in said):
            word = "not a sentence"
        elif isinstance(error, ValueError) or not error.filename:
            if (
                kind.named and file.name not in said and str(file.parent) not in said
            ):  # or what is wrong with the folder that it names
                word = "without the file's name"
            elif not said.isprintable() or len(said) > SENTENCE + len(str(file)):
                word = "no line"
    except Exception as error:  # what else there is to find
        word, said = type(error).__name__, str(error)[:200]
    return Verdict(word, said, time.perf_counter() - begin)


def run_batch(kind: str, seeds: range, folder: Path) -> Iterator[tuple[int, Verdict]]:
    """The seed and the verdict of each case; "memory" where one took more than is allowed."""
    file = folder / kinds()[kind].name
    for seed in seeds:
        file.write_bytes(case(kind, seed))
        before = _peak_megabytes()
        found = verdict(kinds()[kind], file)
        if (more := _peak_megabytes() - before) > MEGABYTES:
            found = found._replace(word="memory", said=f"{more:.0f} MB: {found.said}")
        yield seed, found


def isolated(kind: str, seeds: range) -> Iterator[tuple[int, Verdict]]:
    """The same in a process of its own; a case at which it ends is a "crash", and a new one goes on behind it."""
    while seeds:
        asked = [sys.executable, __file__, "--batch", kind, str(seeds.start), str(seeds.stop)]
        process = subprocess.Popen(asked, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout is not None
        done = seeds.start
        for line in process.stdout:
            if line.startswith("[") and line.endswith("]\n"):
                seed, told = json.loads(line)
                done = seed + 1
                yield seed, Verdict(*told)
        code = process.wait()
        if done < seeds.stop:
            yield done, Verdict("crash", f"the process ended with {code}", 0.0)
            done += 1
        seeds = range(done, seeds.stop)


def main() -> None:
    """All kinds, as asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=list(kinds()))
    parser.add_argument("--batch", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.batch:
        kind, start, stop = asked.batch[0], int(asked.batch[1]), int(asked.batch[2])
        with tempfile.TemporaryDirectory() as place:
            for told in run_batch(kind, range(start, stop), Path(place)):
                print(json.dumps(told), flush=True)
        return
    names = asked.only or list(kinds())
    each = -(-asked.cases // len(names))
    wrong = 0
    print("| file | cases | read | refused | not allowed | slowest, ms |\n|---|---|---|---|---|---|")
    for name in names:
        counts, slowest = Counter[str](), 0.0
        for first in range(0, each, BATCH):
            start = asked.seed * 10**7 + first
            for seed, found in isolated(name, range(start, start + min(BATCH, each - first))):
                if found.took > SECONDS and found.word in ALLOWED:
                    found = found._replace(word="slow")
                counts[found.word] += 1
                slowest = max(slowest, found.took)
                if found.word not in ALLOWED:
                    print(f"    {name} {seed}: {found.word}, {1e3 * found.took:.0f} ms: {found.said[:300]}", flush=True)
        bad = counts.total() - sum(counts[word] for word in ALLOWED)
        wrong += bad
        said = " | ".join(map(str, (each, *(counts[word] for word in ALLOWED), bad)))
        print(f"| {name} | {said} | {1e3 * slowest:.0f} |", flush=True)
    sys.exit(wrong > 0)


def _changed_text(rng: np.random.Generator, data: bytes, whole: tuple[bytes, ...]) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    at = int(rng.integers(len(text) + 1))
    end = min(at + int(rng.geometric(0.03)), len(text))
    token = TOKENS[rng.integers(len(TOKENS))]
    lines = text.split("\n")
    change = rng.integers(9)
    if change == 0:
        text = text[:at] + token + text[at:]
    elif change == 1:
        text = text[:at] + token + text[end:]
    elif change == 2:  # a number
        starts = [i for i, c in enumerate(text) if c.isdigit()]
        if starts:
            at = end = starts[rng.integers(len(starts))]
            while end < len(text) and (text[end].isdigit() or text[end] in ".e"):
                end += 1
            text = text[:at] + token + text[end:]
    elif change == 3:  # nested
        depth = int(rng.choice([3, 40, 900, 20_000]))
        left, right = (("[", "]"), ("{", "}"), ('{"a":', "}"), ("<a>", "</a>"), ("- ", ""), ("a.", ""))[rng.integers(6)]
        text = text[:at] + depth * left + "1" + depth * right + text[at:]
    elif change == 4:  # long
        text = text[:at] + int(rng.choice([100, 5000, 200_000])) * token[:1] + text[at:]
    elif change == 5:
        i, j = rng.integers(len(lines), size=2)
        lines[i], lines[j] = lines[j], lines[i]
        text = "\n".join(lines)
    elif change == 6 and len(text) < 10_000:
        i = int(rng.integers(len(lines)))
        text = "\n".join(lines[:i] + lines[i : i + 1] * int(rng.choice([0, 2, 500])) + lines[i + 1 :])
    elif change == 7:
        other = whole[rng.integers(len(whole))].decode("utf-8", "surrogateescape")
        text = text[:at] + other[int(rng.integers(len(other))) :]
    else:
        words = text.split(" ")
        words[rng.integers(len(words))] = token
        text = " ".join(words)
    return text.encode("utf-8", "surrogatepass" if any("\ud800" <= c <= "\udbff" for c in text) else "surrogateescape")


def _changed_bytes(rng: np.random.Generator, data: bytes, whole: tuple[bytes, ...]) -> bytes:
    out = bytearray(data)
    if not out:
        return data
    # Headers decide most.
    at = int(rng.integers(min(len(out), 100) if rng.random() < 0.6 else len(out)))
    change = rng.integers(6)
    if change == 0:
        out[at] = rng.integers(256)
    elif change == 1:
        value = int(rng.choice([0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF]))
        out[at : at + 4] = value.to_bytes(4, "little" if rng.random() < 0.5 else "big")
    elif change == 2:
        del out[at:]
    elif change == 3:
        del out[at : at + int(rng.geometric(0.1))]
    elif change == 4:
        out[at:at] = rng.bytes(int(rng.geometric(0.02)))
    else:
        other = whole[rng.integers(len(whole))]
        out[at:] = other[int(rng.integers(len(other))) :]
    return bytes(out)


def _peak_megabytes() -> float:
    with suppress(ImportError):  # Windows has none
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return 0.0


def _saved(rig: Rig, file: Path) -> bytes:
    calibration.save(rig, file)
    return file.read_bytes()


def _trajectory(folder: Path) -> tuple[bytes, bytes]:
    with TrajectoryWriter(folder, RIG.names, "m") as writer:
        for k in range(5):
            pose = RigidTransform.from_translation([0.1 * k, 0.0, 1.0])
            seen = np.array([9, 8, 7]), np.array([0.3, 0.2, 0.1])
            writer.write(FramePose(k, k / 30, FrameStatus.TRACKED, pose, 0.01 * np.eye(6), *seen))
    return (folder / "trajectory.csv").read_bytes(), (folder / "trajectory.tum").read_bytes()


def _with_others(file: Path, sample: Sample) -> object:
    """A calibration of several files, of which one is changed."""
    for name, content in sample.beside.items():
        if name != file.name:
            (file.parent / name).write_bytes(content)
    return calibration.load(file, lambda names: dict.fromkeys(names, SIZE))


def _image(file: Path) -> object:
    image_size(file)
    return read_image(file, SIZE)


def _live(file: Path) -> object:
    calibration.save(RIG, file.parent / "rig.toml")
    return open_live(file)


def _pixels(file: Path) -> object:
    return load_pixels([file], RIG.names)


def _manifest(file: Path) -> object:
    return find_recordings([str(file)], Options())


def _content(value: object, functions: Mapping[str, Callable[..., object]]) -> bytes:
    """As in a file of tracks or a checkpoint, after the length of its table."""
    table, *blocks = encoded(value, KINDS, functions)
    return len(table).to_bytes(8, "little") + b"".join([table, *blocks])


def _tracked() -> tuple[Track, RunState]:
    """Of two small images that differ."""
    rig, rng = ring(2, size=(96, 72), focal=90.0), np.random.default_rng(0)
    textures = [cv2.resize(rng.integers(0, 255, (18, 24, 3), np.uint8), (96, 72)) for _ in rig]
    with Tracker(rig, {name: Box(8, 8, 80, 56) for name in rig.names}, workers=1) as tracker:
        decided = []
        for k in range(2):
            images = tuple(np.roll(texture, 2 * k, axis=1).astype(np.uint8) for texture in textures)
            decided += tracker.step(FrameSet(k, k / 30, (None, None), images, (None, None)))
        state = RunState(2, {"": tracker.remembered()}, {"": OutputState()})
    return Track.of(decided[0]), state


def _tracks(file: Path) -> object:
    """With a checksum that fits."""
    data = file.read_bytes()
    content = data[8:]
    tracks = file.parent / "tracks.bin"
    tracks.write_bytes(_FRAME.pack(int.from_bytes(data[:8], "little"), len(content), zlib.crc32(content)) + content)
    found = FrameFile(tracks, Track, tracks.stat().st_size)
    try:
        return list(found.read())
    finally:
        found.close()


def _checkpoint(file: Path) -> object:
    """The same."""
    header = {"version": __version__, "options": {}, "session": {}}
    data = FORMAT + json.dumps(header).encode() + b"\n" + file.read_bytes()
    checkpoint = file.parent / CHECKPOINT
    checkpoint.write_bytes(data + blake2b(data).digest())
    return load_checkpoint(checkpoint, {}, {})


def _message(file: Path) -> object:
    """Of any kind that is expected, and what is said of what it means."""
    data, refused = file.read_bytes(), None
    for nothing in TOLD:
        try:
            told = unpacked(data, nothing)
            if why := objection(told, 1):
                raise ValueError(why)
            return told
        except ValueError as error:
            refused = error
    raise refused or ValueError("none")


def _word(file: Path) -> object:
    data = file.read_bytes()
    return read_hello(1, data) or read_welcome(0, 3, 1, data) or read_word(1, data, 5)


def _moments(file: Path) -> object:
    return plausible(decode(file.read_bytes(), 1, (45,)).values, True)


CAMERA = b"""size = [64, 48]
matrix = [[1000.0, 0.0, 20.0], [0.0, 1000.0, 15.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [0.0, 0.0, 1.0]
"""
ANIPOSE = b'[cam_0]\nname = "left"\n' + CAMERA + b'[cam_1]\nname = "right"\n' + CAMERA + b"[metadata]\nerror = 0.4\n"
CALISCOPE = b"[cameras.0]\nport = 0\nerror = 0.2\n" + CAMERA + b"[cameras.12]\nignore = false\n" + CAMERA
BY_HAND = b"""# written by hand
cam_0:
  image_size: [64, 48]
  K: [[800.0, 0, 20], [0, 800, 15], [0, 0, 1]]
  dist: [[0.1, 0, 0, 0, 0]]
  rvec: [0.1, 0.2, 0.3]
  tvec:
  - 1.0
  - 2.0
  - 3.0
"""
LENS = {"model": "standard", "image_size": [64, 48], "K": [[8e2, 0, 2e1], [0, 8e2, 15], [0, 0, 1]], "dist": [[0.0] * 5]}
POSE = {"R": np.eye(3).tolist(), "T": [0.1, 0.2, 3.0]}
MULTICAL = json.dumps({"cameras": {"a": LENS, "b": LENS}, "camera_poses": {"a": POSE, "b_to_a": POSE}}).encode()
BOXES = b"cam_0 = [1, 2, 30, 20]\ncam_1 = [2.5, 3, 10.0, 9]\ncam_2 = [0, 0, 40, 30]\n"
SEVERAL = b"[mug]\ncam_0 = [1, 2, 30, 20]\n[head]\ncam_1 = [2, 3, 10, 9]\ncam_0 = [2, 3, 10, 9]\n"
OFFSETS = b"cam_0 = 0.0\ncam_1 = 0.0042\ncam_2 = -1.5 # seconds\n"
LIVE = b"""calibration = "rig.toml"
max_delay = 0.2
rate = 60
[sources]
cam_0 = 0
cam_1 = "/dev/video2"
cam_2 = "rtsp://192.168.0.12/stream"
"""
MANIFEST = (
    b'[[recording]]\npath = "."\nname = "one"\nevery = 2\n[[recording]]\npath = "none"\nsmooth = false\nstart = 3\n'
)
LISTED = b"path,name,every,smooth\n.,one,2,\nnone,two,,true\n"
POINTS = b'name,x,y,z\nnose,0.01,-0.02,0.5\nleft ear,1e-3,0,-1\n"right, ear",0,0,0\ntail,1,2,3\n'
NAMED = b'unit = "mm"\n\n[points]\nnose = [0, 0, 12.5]\n"left ear" = [-3, 4.5, 1e1]\n'
MARKERS = b"""unit = "mm"
family = "apriltag:36h11"
size = 40

[markers.0]
center = [0, 0, 25]
x = [1, 0, 0]
y = [0, 1, 0]

[markers.7]
corners = [[20, 25, -20], [20, 25, 20], [-20, 25, 20], [-20, 25, -20]]
"""
PLY = b"""ply
format ascii 1.0
comment by hand
element vertex 3
property float x
property float y
property double z
property uchar red
element face 1
property list uchar int vertex_index
end_header
0 0 0 1
1 0.5 0 2
0 1 -1e-2 3
3 0 1 2
"""
PLY_BINARY = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n" + b"".join(
    b"property float %c\n" % axis for axis in b"xyz"
)
PLY_BINARY += b"end_header\n" + np.arange(12, dtype="<f4").tobytes()
OBJ = b"# a mesh\no box\nv 0 0 0\nv 1.0 2 3e0 0.5 0.5 0.5\nvn 0 0 1\nv -1 0 0\nf 1/1/1 2/2/1 3\n"
PIXELS = b"camera,frame,name,u,v,likelihood,time\n" + b"".join(
    b"cam_%d,%d,p%d,%.2f,%.2f,0.9,%.3f\n" % (c, k, n, 10 + n, 20.5 + k, k / 30)
    for k in range(3)
    for c in range(3)
    for n in range(4)
)
DEEPLABCUT = b"scorer,net,net,net,net,net,net\nbodyparts,a,a,a,b,b,b\ncoords,x,y,likelihood,x,y,likelihood\n"
DEEPLABCUT += b"".join(b"%d,1.5,2,0.99,%d,4,0.1\n" % (k, k) for k in range(6))
STAMPS = b"frame,cam_0,cam_1,cam_2\n" + b"".join(b"%d,%.3f,%.3f,\n" % (k, k / 30, k / 30 + 0.001) for k in range(9))
# What a camera may tell of itself.
SIGHTS = Sights(
    np.ones((5, 3)), np.ones((5, 3)), np.ones((5, 2)), np.arange(5), np.ones(5), np.eye(3), np.zeros(3), 700.0
)
TOLD: tuple[object, ...] = (
    Says(np.concatenate([np.eye(6)[np.triu_indices(6)], np.zeros(6)]), 3.5, np.nan),
    Following(12, 30, True, False),
    Moved(TermData(1, np.ones((7, 2)), np.ones((7, 2)), np.eye(3), np.zeros(3), 812.5), np.ones(7), 0.25, 9),
    Known(SIGHTS, np.ones(5)),
    Recognised(np.ones((6, 3)), np.ones((6, 2))),
    Seen(np.arange(4), np.arange(4), np.ones((4, 2)), np.arange(2), np.ones((2, 3))),
    (Judges(1.5, 2.5, 17, 20, 12.5), Roll(12, 0.5, (1, 2), False, True)),
)


if __name__ == "__main__":
    main()
