"""Fuzzing of all readers of files and node messages.

    python benchmarks/fuzz.py [--cases N] [--seed S] [--only KIND ...]

Files of every kind (calibrations, settings, tables, images, object models; tracks, checkpoints and the arrays of object
models with valid checksums, so that their content is reached) and node messages are mutated at random, seeded. Bytes,
lines and numbers are replaced, cut, repeated, nested, or joined with those of another file. A reader may return a result
or raise a `ValueError` or `OSError`. The error must be one printable line of at most `MAX_SENTENCE_CHARS` characters with
the file's name (except for messages). Both must stay within `MAX_SECONDS` and `MAX_MEGABYTES`.

Batches run in separate processes. If a signal ends one, its case counts as a crash and the batch continues after it. Prints
a row for each kind, and the cases that fail.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.fuzz_calibrations import SAMPLES, Sample
from sylpose import __version__
from sylpose.archive.recordings import TrackingOptions, find_recordings
from sylpose.features.sift import Features
from sylpose.frames import Box, FrameSet
from sylpose.input_limits import MAX_MESSAGE_LENGTH
from sylpose.io import calibration
from sylpose.io.capture.boxes import load_boxes
from sylpose.io.capture.images import read_image, read_image_size
from sylpose.io.capture.live import open_live
from sylpose.io.capture.time_tables import find_time_table
from sylpose.io.object_files import load_object, save_object
from sylpose.io.point_files import load_image_points, load_points
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.landmark_filter import Landmarks
from sylpose.landmarks.messages import EvaluationMessage, TermsMessage
from sylpose.moments import PairMoments
from sylpose.network import codec
from sylpose.network.codec import FrameAnnouncement
from sylpose.network.plausibility import find_implausibility
from sylpose.network.wire_format import (
    DATA,
    EXCLUSION,
    Hello,
    Welcome,
    decode_hello,
    decode_message,
    decode_welcome,
    encode_hello,
    encode_message,
    encode_relay,
    encode_welcome,
)
from sylpose.relative_pose.terms import TermData
from sylpose.report.files import TrajectoryWriter, read_trajectory, read_tum
from sylpose.results import FramePose
from sylpose.rig import Rig
from sylpose.runs.checkpoint import _FRAME, CHECKPOINT, FORMAT, FrameFile, load_checkpoint
from sylpose.runs.checkpoint_schema import SERIALIZER, OutputState, RunState
from sylpose.simulate import ring
from sylpose.smoothing import Track
from sylpose.status import FrameStatus
from sylpose.sync.offsets import load_offsets
from sylpose.tracking.joint_side.joint_state import SolvedFrame
from sylpose.tracking.known_object import CameraLandmarks, KnownObject
from sylpose.tracking.reports import (
    KnownDepthMatches,
    MovingMatches,
    NewObservations,
    RelocalizationMatches,
    TrackingReport,
)
from sylpose.tracking.tracker import Tracker

ALLOWED = ("result", "sentence")
MAX_SECONDS, MAX_MEGABYTES = 0.2, 100.0
# A sentence may contain the messages of two files.
MAX_SENTENCE_CHARS = 2 * MAX_MESSAGE_LENGTH
SIZE = (64, 48)
BATCH_SIZE = 1000
# Largest cases, bytes: above the limits of calibrations and settings; tables may be large, this bounds their time.
MAX_CASE_BYTES, MAX_TABLE_BYTES = 1_200_000, 200_000
TABLES = (
    *("manifest", "manifest, csv", "time stamps", "trajectory.csv", "trajectory.tum"),
    *("points, csv", "points, ply", "points, binary", "points, obj", "pixels", "deeplabcut"),
)
RIG: Rig = ring(3, size=SIZE)
IMAGES = (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm", ".jp2")
# Replacements of numbers, words and values.
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
    """Kind of file.

    Attributes:
        name: file name.
        samples: valid contents.
        read: reader.
        is_text: the content is text.
        has_file_name: errors contain the file's name.
    """

    name: str
    samples: tuple[bytes, ...]
    read: Callable[[Path], object]
    is_text: bool = True
    has_file_name: bool = True


@cache
def make_kinds() -> dict[str, Kind]:
    """Return all kinds of files by name."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        saved = {
            s: [_save_calibration(rig, folder / f"a{s}") for rig in (RIG, ring(1))]
            for s in (".toml", ".yml", ".json", ".xml")
        }
        table, tum = _write_trajectory(folder)
    load = calibration.load
    file_kinds = {
        "sylpose": Kind("calibration.toml", tuple(saved[".toml"]), load),
        "anipose": Kind("calibration.toml", (ANIPOSE, *saved[".toml"]), load),
        "caliscope": Kind("camera_array.toml", (CALISCOPE, ANIPOSE), load),
        "yaml": Kind("calibration.yml", (*saved[".yml"], HANDWRITTEN_YAML), load),
        "json": Kind("calibration.json", (*saved[".json"], MULTICAL), load),
        "xml": Kind("calibration.xml", tuple(saved[".xml"]), load),
        "boxes": Kind("boxes.toml", (BOXES, SEVERAL_BOXES), partial(load_boxes, rig=RIG)),
        "offsets": Kind("offsets.toml", (OFFSETS,), partial(load_offsets, cameras=RIG.names)),
        "live": Kind("live.toml", (LIVE,), _open_live),
        "manifest": Kind("manifest.toml", (MANIFEST,), _find_recordings),
        "manifest, csv": Kind("manifest.csv", (MANIFEST_CSV,), _find_recordings),
        "time stamps": Kind(
            "timestamps.csv", (STAMPS, STAMPS_BY_FRAME), lambda path: find_time_table(path.parent, RIG.names)
        ),
        "trajectory.csv": Kind("trajectory.csv", (table,), read_trajectory),
        "trajectory.tum": Kind("trajectory.tum", (tum,), read_tum),
        "points, csv": Kind("points.csv", (POINTS,), load_points),
        "points, toml": Kind("points.toml", (NAMED_POINTS, MARKERS), load_points),
        "points, ply": Kind("points.ply", (PLY,), load_points),
        "points, binary": Kind("points.ply", (PLY_BINARY,), load_points, is_text=False),
        "points, obj": Kind("points.obj", (OBJ,), load_points),
        "pixels": Kind("pixels.csv", (PIXELS,), _load_pixels),
        "deeplabcut": Kind("cam_0DLC.csv", (DEEPLABCUT,), _load_pixels),
    }
    for name, sample in SAMPLES.items():
        file_kinds[name] = Kind(sample.name, sample.samples, partial(_load_with_others, sample=sample), sample.is_text)
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8), np.zeros((SIZE[1], SIZE[0], 3), np.uint8)]
    for suffix in IMAGES:
        whole = tuple(bytes(cv2.imencode(suffix, picture)[1]) for picture in pictures)
        file_kinds[suffix[1:]] = Kind(f"0000{suffix}", whole, _read_image, is_text=False)
    track, state = _track_two_frames()
    whole_object = _save_object()
    file_kinds["object.npz"] = Kind("object.npz", (whole_object,), load_object, is_text=False)
    with zipfile.ZipFile(io.BytesIO(whole_object)) as archive:
        members = tuple(name.encode() + b"\0" + archive.read(name) for name in archive.namelist())
    file_kinds["object, arrays"] = Kind("object.npz", members, _load_object_with_array, is_text=False)
    file_kinds["tracks.bin"] = Kind("content.bin", (b"".join(SERIALIZER.dump(track)),), _tracks, is_text=False)
    file_kinds["checkpoint"] = Kind("content.bin", (b"".join(SERIALIZER.dump(state)),), _load_checkpoint, is_text=False)
    packed_messages = [codec.encode(one) for one in MESSAGES]
    number = Hello(2, 7), Welcome(5, 9, frozenset({0, 1}), packed_messages[0])
    words = [
        encode_message(DATA, 1, 5, 9, packed_messages[0]),
        encode_welcome(1, number[1]),
        encode_hello(1, 9, number[0]),
    ]
    words.append(
        encode_relay(EXCLUSION, 1, 5, 9, frozenset({2}), frozenset({0}), {0: packed_messages[1], 2: packed_messages[2]})
    )
    x = np.random.default_rng(0).uniform(-0.2, 0.2, (2, 30, 2))
    file_kinds["message"] = Kind("message", tuple(packed_messages), _unpack_message, is_text=False, has_file_name=False)
    file_kinds["word"] = Kind("word", tuple(words), _read_wire_message, is_text=False, has_file_name=False)
    moments = (PairMoments.from_matches(*x).to_bytes(),)
    file_kinds["moments"] = Kind("moments", moments, _read_moments, is_text=False, has_file_name=False)
    return file_kinds


def make_case(kind: str, seed: int) -> bytes:
    """Return a mutated file of a kind."""
    rng = np.random.default_rng([seed, *kind.encode()])
    samples = make_kinds()[kind].samples
    data = samples[rng.integers(len(samples))]
    text = make_kinds()[kind].is_text
    for _ in range(1 + rng.poisson(1.5)):
        data = _mutate_text(rng, data, samples) if text and rng.random() < 0.8 else _mutate_bytes(rng, data, samples)
        data = data[: MAX_TABLE_BYTES if kind in TABLES else max(MAX_CASE_BYTES, 2 * len(samples[0]))]
    return data


class Verdict(NamedTuple):
    """Outcome of reading a file: "result", "sentence" or the name of a failure; the message; the time in seconds."""

    outcome: str
    message: str
    seconds: float


def read_and_classify(kind: Kind, file: Path) -> Verdict:
    """Read a file and classify the outcome."""
    begin = time.perf_counter()
    try:
        kind.read(file)
        outcome, message = "result", ""
    except (ValueError, OSError) as error:
        outcome, message = "sentence", str(error)
        # Messages about pickles may name objects of NumPy.
        if type(error).__name__ == "LinAlgError" or ("numpy" in message and "a pickle that refers to" not in message):
            outcome = "not a sentence"
        elif isinstance(error, ValueError) or not error.filename:
            if (
                kind.has_file_name and file.name not in message and str(file.parent) not in message
            ):  # the message may be about a folder that the file names
                outcome = "without the file's name"
            elif not message.isprintable() or len(message) > MAX_SENTENCE_CHARS + len(str(file)):
                outcome = "no line"
    except Exception as error:  # any other exception is a failure to report
        outcome, message = type(error).__name__, str(error)[:200]
    return Verdict(outcome, message, time.perf_counter() - begin)


def run_batch(kind: str, seeds: range, folder: Path) -> Iterator[tuple[int, Verdict]]:
    """Yield the seed and the verdict of each case; the word is "memory" if it exceeded the memory limit."""
    file = folder / make_kinds()[kind].name
    for seed in seeds:
        file.write_bytes(make_case(kind, seed))
        before = _peak_megabytes()
        found = read_and_classify(make_kinds()[kind], file)
        if (increase := _peak_megabytes() - before) > MAX_MEGABYTES:
            found = found._replace(outcome="memory", message=f"{increase:.0f} MB: {found.message}")
        yield seed, found


def run_isolated_batch(kind: str, seeds: range) -> Iterator[tuple[int, Verdict]]:
    """Run a batch in a separate process; a case that ends the process is a "crash", and a new process continues."""
    while seeds:
        command = [sys.executable, __file__, "--batch", kind, str(seeds.start), str(seeds.stop)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert process.stdout is not None
        next_seed = seeds.start
        for line in process.stdout:
            if line.startswith("[") and line.endswith("]\n"):
                seed, fields = json.loads(line)
                next_seed = seed + 1
                yield seed, Verdict(*fields)
        code = process.wait()
        if next_seed < seeds.stop:
            yield next_seed, Verdict("crash", f"the process ended with {code}", 0.0)
            next_seed += 1
        seeds = range(next_seed, seeds.stop)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, help="number of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=list(make_kinds()))
    parser.add_argument("--batch", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.batch:
        kind, start, stop = arguments.batch[0], int(arguments.batch[1]), int(arguments.batch[2])
        with tempfile.TemporaryDirectory() as place:
            for result in run_batch(kind, range(start, stop), Path(place)):
                print(json.dumps(result), flush=True)
        return
    names = arguments.only or list(make_kinds())
    cases_per_kind = -(-arguments.cases // len(names))
    n_failures = 0
    print("| file | cases | read | rejected | failures | slowest, ms |\n|---|---|---|---|---|---|")
    for name in names:
        counts, slowest = Counter[str](), 0.0
        for first in range(0, cases_per_kind, BATCH_SIZE):
            start = arguments.seed * 10**7 + first
            for seed, found in run_isolated_batch(name, range(start, start + min(BATCH_SIZE, cases_per_kind - first))):
                if found.seconds > MAX_SECONDS and found.outcome in ALLOWED:
                    found = found._replace(outcome="slow")
                counts[found.outcome] += 1
                slowest = max(slowest, found.seconds)
                if found.outcome not in ALLOWED:
                    print(
                        f"    {name} {seed}: {found.outcome}, {1e3 * found.seconds:.0f} ms: {found.message[:300]}",
                        flush=True,
                    )
        n_kind_failures = counts.total() - sum(counts[word] for word in ALLOWED)
        n_failures += n_kind_failures
        counts_text = " | ".join(map(str, (cases_per_kind, *(counts[word] for word in ALLOWED), n_kind_failures)))
        print(f"| {name} | {counts_text} | {1e3 * slowest:.0f} |", flush=True)
    sys.exit(n_failures > 0)


def _mutate_text(rng: np.random.Generator, data: bytes, samples: tuple[bytes, ...]) -> bytes:
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
        other = samples[rng.integers(len(samples))].decode("utf-8", "surrogateescape")
        text = text[:at] + other[int(rng.integers(len(other))) :]
    else:
        words = text.split(" ")
        words[rng.integers(len(words))] = token
        text = " ".join(words)
    return text.encode("utf-8", "surrogatepass" if any("\ud800" <= c <= "\udbff" for c in text) else "surrogateescape")


def _mutate_bytes(rng: np.random.Generator, data: bytes, samples: tuple[bytes, ...]) -> bytes:
    out = bytearray(data)
    if not out:
        return data
    # Mutations of headers reach most code.
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
        other = samples[rng.integers(len(samples))]
        out[at:] = other[int(rng.integers(len(other))) :]
    return bytes(out)


def _peak_megabytes() -> float:
    with suppress(ImportError):  # Windows has none
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return 0.0


def _save_calibration(rig: Rig, file: Path) -> bytes:
    calibration.save(rig, file)
    return file.read_bytes()


def _write_trajectory(folder: Path) -> tuple[bytes, bytes]:
    with TrajectoryWriter(folder, RIG.names, "m") as writer:
        for k in range(5):
            pose = RigidTransform.from_translation([0.1 * k, 0.0, 1.0])
            seen = np.array([9, 8, 7]), np.array([0.3, 0.2, 0.1])
            writer.write(FramePose(k, k / 30, FrameStatus.TRACKED, pose, 0.01 * np.eye(6), *seen))
    return (folder / "trajectory.csv").read_bytes(), (folder / "trajectory.tum").read_bytes()


def _load_with_others(file: Path, sample: Sample) -> object:
    """Load a calibration of several files, one of which is mutated."""
    for name, content in sample.other_files.items():
        if name != file.name:
            (file.parent / name).write_bytes(content)
    return calibration.load(file, lambda names: dict.fromkeys(names, SIZE))


def _read_image(file: Path) -> object:
    read_image_size(file)
    return read_image(file, SIZE)


def _open_live(file: Path) -> object:
    calibration.save(RIG, file.parent / "rig.toml")
    return open_live(file)


def _load_pixels(file: Path) -> object:
    return load_image_points([file], RIG.names)


def _load_time_table(path: Path) -> object:
    return find_time_table(path.parent, RIG.names)


def _find_recordings(file: Path) -> object:
    return find_recordings([str(file)], TrackingOptions())


def _track_two_frames() -> tuple[Track, RunState]:
    """Track two small frames; return the track and the state of the run."""
    rig, rng = ring(2, size=(96, 72), focal=90.0), np.random.default_rng(0)
    textures = [cv2.resize(rng.integers(0, 255, (18, 24, 3), np.uint8), (96, 72)) for _ in rig]
    with Tracker(rig, {name: Box(8, 8, 80, 56) for name in rig.names}, workers=1) as tracker:
        decided = []
        for k in range(2):
            images = tuple(np.roll(texture, 2 * k, axis=1).astype(np.uint8) for texture in textures)
            decided += tracker.step(FrameSet(k, k / 30, (None, None), images, (None, None)))
        state = RunState(2, {"": tracker.copy_snapshot()}, {"": OutputState()})
    return Track.from_tracked(decided[0]), state


def _save_object() -> bytes:
    """Return the file of a small object model."""
    rng, n = np.random.default_rng(0), 4
    empty = {"time_offsets": np.empty(0), "viewpoints": np.empty((0, 3)), "is_visible": np.empty(0, bool)}
    keyframes = tuple(
        SolvedFrame(
            number=k,
            time=0.5 * k,
            world_from_object=RigidTransform.from_translation([0.1 * k, 0.0, 1.0]),
            covariance=0.01 * np.eye(6),
            landmark_age=3.0,
            is_fixed=True,
            is_contradicted=False,
            n_uncertain=0,
            **empty,
        )
        for k in range(2)
    )
    features = Features(rng.uniform(0, 40, (n, 2)), rng.normal(size=(n, 2)), np.full((n, 128), 0.088, np.float32))
    information, many = np.tile(np.eye(3), (n, 1, 1)), np.full(n, 5)
    landmarks = Landmarks(
        rng.normal(size=(n, 3)), information, many, np.ones(n, bool), rng.normal(size=(n, 2)), np.arange(n)
    )
    memory = CameraLandmarks(landmarks, (features, features), (np.arange(n), np.arange(n)))
    known = KnownObject(RIG, 0.3, "0a1b", rng.normal(size=(n, 3)), keyframes, dict.fromkeys(RIG.names, memory))
    with tempfile.TemporaryDirectory() as folder:
        save_object(known, Path(folder, "object.npz"))
        return Path(folder, "object.npz").read_bytes()


def _load_object_with_array(file: Path) -> object:
    """Load an object model of which one array is mutated, with a valid checksum."""
    mutated, _, content = file.read_bytes().partition(b"\0")
    with zipfile.ZipFile(io.BytesIO(make_kinds()["object.npz"].samples[0])) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    contents[mutated.decode("latin-1") or "unnamed"] = content
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return load_object(file)


def _tracks(file: Path) -> object:
    """Read tracks with a valid checksum."""
    content = file.read_bytes()
    tracks = file.parent / "tracks.bin"
    tracks.write_bytes(_FRAME.pack(len(content), zlib.crc32(content)) + content)
    found = FrameFile(tracks, Track, tracks.stat().st_size)
    try:
        return list(found.read())
    finally:
        found.close()


def _load_checkpoint(file: Path) -> object:
    """Load a checkpoint with a valid checksum."""
    header = {"version": __version__, "options": {}, "session": {}}
    data = FORMAT + json.dumps(header).encode() + b"\n" + file.read_bytes()
    checkpoint = file.parent / CHECKPOINT
    checkpoint.write_bytes(data + blake2b(data).digest())
    return load_checkpoint(checkpoint, {}, {})


def _unpack_message(file: Path) -> object:
    """Unpack a message as any of the expected kinds and check its plausibility."""
    data, last_error = file.read_bytes(), None
    for template in MESSAGES:
        try:
            content = codec.decode(data, template)
            if reason := find_implausibility(content, 1):
                raise ValueError(reason)
            return content
        except ValueError as error:
            last_error = error
    raise last_error or ValueError("none")


def _read_wire_message(file: Path) -> object:
    data = file.read_bytes()
    return decode_hello(1, data) or decode_welcome(0, 3, 1, data) or decode_message(1, data, 5)


def _read_moments(file: Path) -> object:
    return PairMoments.from_bytes(file.read_bytes())


CAMERA = b"""size = [64, 48]
matrix = [[1000.0, 0.0, 20.0], [0.0, 1000.0, 15.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [0.0, 0.0, 1.0]
"""
ANIPOSE = b'[cam_0]\nname = "left"\n' + CAMERA + b'[cam_1]\nname = "right"\n' + CAMERA + b"[metadata]\nerror = 0.4\n"
CALISCOPE = b"[cameras.0]\nport = 0\nerror = 0.2\n" + CAMERA + b"[cameras.12]\nignore = false\n" + CAMERA
HANDWRITTEN_YAML = b"""# written by hand
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
SEVERAL_BOXES = b"[mug]\ncam_0 = [1, 2, 30, 20]\n[head]\ncam_1 = [2, 3, 10, 9]\ncam_0 = [2, 3, 10, 9]\n"
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
MANIFEST_CSV = b"path,name,every,smooth\n.,one,2,\nnone,two,,true\n"
POINTS = b'name,x,y,z\nnose,0.01,-0.02,0.5\nleft ear,1e-3,0,-1\n"right, ear",0,0,0\ntail,1,2,3\n'
NAMED_POINTS = b'unit = "mm"\n\n[points]\nnose = [0, 0, 12.5]\n"left ear" = [-3, 4.5, 1e1]\n'
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
STAMPS_BY_FRAME = b"cam_id,frame_time\n" + b"".join(b"%d,%.4f\n" % (k % 3, 900 + k / 90) for k in range(27))
# Messages of a camera.
OBSERVATIONS = LandmarkMatches(
    np.ones((5, 3)), np.ones((5, 3)), np.ones((5, 2)), np.arange(5), np.ones(5), np.eye(3), np.zeros(3), 700.0
)
MESSAGES: tuple[object, ...] = (
    TermsMessage(np.concatenate([np.eye(6)[np.triu_indices(6)], np.zeros(6)]), 3.5, np.nan),
    TrackingReport(12, 30, True, False),
    MovingMatches(TermData(1, np.ones((7, 2)), np.ones((7, 2)), np.eye(3), np.zeros(3), 812.5), np.ones(7), 0.25, 9),
    KnownDepthMatches(OBSERVATIONS, np.ones(5)),
    RelocalizationMatches(np.ones((6, 3)), np.ones((6, 2))),
    NewObservations(np.arange(4), np.arange(4), np.ones((4, 2)), np.arange(2), np.ones((2, 3))),
    (EvaluationMessage(1.5, 2.5, 17, 20, 12.5), FrameAnnouncement(12, 0.5, (1, 2), False, True)),
)


if __name__ == "__main__":
    main()
