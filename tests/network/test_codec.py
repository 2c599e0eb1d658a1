"""Encoding is lossless to the bit, and invalid data is rejected."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import LandmarkMatches
from sylpose.landmarks.messages import EvaluationMessage, TermsMessage
from sylpose.network.codec import MAX_PAYLOAD_BYTES, RECORDS, FrameAnnouncement, decode, encode
from sylpose.network.wire_format import HEADER
from sylpose.relative_pose.camera_evidence import CameraEvidence
from sylpose.relative_pose.terms import TermData
from sylpose.serialization import decode_array, encode_array
from sylpose.tracking.joint_side.joint_state import (
    Anchor,
    JointState,
    KnownFrames,
    MotionModel,
    Nudge,
    ObjectMotion,
    PoseEstimate,
    Refinement,
    SolvedFrame,
)
from sylpose.tracking.joint_side.object_model import ObjectModel
from sylpose.tracking.reports import (
    BoxMotionReport,
    CameraMotionReport,
    CameraObservations,
    CameraTerms,
    InitialMatches,
    InlierStatistics,
    KnownDepthMatches,
    LandmarkAges,
    MovingMatches,
    NewObservations,
    PoseAgreement,
    RelocalizationMatches,
    TrackingReport,
)
from sylpose.tracking.tracker import BufferedRecord, Handover

RNG = np.random.default_rng(0)


def random_array(*shape: int) -> FloatArray:
    return RNG.standard_normal(shape)


def random_integers(n: int) -> Any:
    return RNG.integers(0, 1000, n)


POSE = RigidTransform.from_components([0.1, -2.0, 3.0], Rotation.from_rotvec([0.3, 0.2, -0.1]))
TERM = TermData(2, random_array(7, 2), random_array(7, 2), np.eye(3), random_array(3), 812.5, POSE)
SIGHTS = LandmarkMatches(
    random_array(5, 3),
    random_array(5, 3),
    random_array(5, 2),
    random_integers(5),
    random_array(5),
    np.eye(3),
    random_array(3),
    700.0,
)
AGES = LandmarkAges(random_array(4), random_array(4), 3, np.nan)
EVIDENCE = CameraEvidence(12, 0.3, 0.9, 4.5)
MODEL = ObjectModel(random_array(3), 0.3, random_array(9, 3), True, False)
SOLVED = SolvedFrame(
    7,
    0.25,
    random_array(3),
    POSE,
    random_array(6, 6),
    random_array(3, 3),
    np.array([True, False, True]),
    2.5,
    is_contradicted=True,
)
VELOCITY = MotionModel(random_array(6), random_array(6), 4, 0.03)
NUDGE = Nudge(1, 5, random_array(3), 0.01)
JOINT = JointState(
    MODEL,
    KnownFrames(SOLVED, (SOLVED, SOLVED), (SOLVED,), Anchor(SOLVED, 3, True), 6),
    ObjectMotion(VELOCITY, True, (3, POSE), PoseEstimate(POSE, random_array(6, 6)), 2, False, True, POSE, 9),
    Refinement(random_array(6, 6), SOLVED, rests_on_prior=True),
    (NUDGE,),
)
WAITED = BufferedRecord(3, 0.1, np.array([0.1, np.nan, 0.1]), 2, random_array(3), POSE)
SAMPLES = [
    TermsMessage(random_array(27), 3.5, np.nan),
    EvaluationMessage(1.5, 2.5, 17, 20, 12.5),
    TrackingReport(12, 30, True, False),
    MovingMatches(TERM, random_array(7), 0.25, 9),
    InitialMatches((MovingMatches(TERM, random_array(7), 0.25, 9),) * 2),
    BoxMotionReport(4, np.nan, False, 3, 1.5),
    AGES,
    InlierStatistics(30, 20, 25, 1.25, 3),
    KnownDepthMatches(SIGHTS, random_array(5)),
    PoseAgreement(9, 12, (0, 3), (1.5, 2.0), AGES, 8, 7, 0.5, True, 5, 4, 0.25, 10, EVIDENCE, 3),
    EVIDENCE,
    RelocalizationMatches(random_array(6, 3), random_array(6, 2)),
    CameraMotionReport(True, random_array(3), 0.01, 17, True),
    NewObservations(random_integers(4), random_integers(4), random_array(4, 2), random_integers(2), random_array(2, 3)),
    TERM,
    SIGHTS,
    CameraTerms((TERM, TERM)),
    CameraObservations(
        random_integers(4),
        random_integers(4),
        random_array(4, 2),
        random_integers(2),
        random_array(2, 3),
        random_integers(2),
    ),
    Handover(JOINT, (WAITED, WAITED), 8),
    WAITED,
    JOINT,
    MODEL,
    SOLVED,
    Anchor(SOLVED),
    VELOCITY,
    NUDGE,
    FrameAnnouncement(12, np.nan, (1, 3), False, True),
    JOINT.frames,
    JOINT.motion.independent_pose,
    JOINT.motion,
    JOINT.refinement,
]


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, RigidTransform):
        np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=1e-15)
    elif isinstance(a, (tuple, list)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        np.testing.assert_array_equal(a, b)


def test_each_record_has_sample() -> None:
    assert [type(sample) for sample in SAMPLES] == [record.type for record in RECORDS]


@pytest.mark.parametrize("sample", SAMPLES, ids=[type(s).__name__ for s in SAMPLES])
def test_records_round_trip(sample: Any) -> None:
    assert_same(decode(encode(sample), sample), sample)
    assert_same(decode(encode((sample, sample)), (sample, sample)), (sample, sample))


@pytest.mark.parametrize("value", [0, 17, 2.5, np.nan, True, (3, 1.5), np.zeros((0, 3)), random_array(4, 3)])
def test_plain_values_round_trip(value: Any) -> None:
    assert_same(decode(encode(value), value), value)


def test_numpy_scalars_are_encoded() -> None:
    assert decode(encode(np.int64(3)), 0) == 3
    assert decode(encode(3), 0.0) == 3.0
    assert decode(encode((np.int64(1), np.float64(2))), (0, 0.0)) == (1, 2.0)


def test_alignment_round_fits_into_256_bytes() -> None:
    assert HEADER.size + len(encode(SAMPLES[0])) <= 256


@settings(max_examples=120)
@given(sample=st.sampled_from(SAMPLES), data=st.data())
def test_tampered_data_is_rejected_or_valid(sample: Any, data: st.DataObject) -> None:
    """With bytes changed, removed or inserted, any decoded value has valid types and shapes."""
    wire = bytearray(encode(sample))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(len(wire) - 1, 0)))
        how = data.draw(st.sampled_from(["change", "cut", "insert"]))
        if how == "change" and wire:
            wire[at] = data.draw(st.integers(0, 255))
        elif how == "cut":
            del wire[at:]
        else:
            wire[at:at] = bytes([data.draw(st.integers(0, 255))])
    try:
        found = decode(bytes(wire), sample)
    except ValueError:
        return
    assert type(found) is type(sample)
    for field in fields(found):
        mine, its = getattr(found, field.name), getattr(sample, field.name)
        assert type(mine) is type(its) or mine is None or its is None
        if isinstance(mine, np.ndarray) and its is not None:
            assert (mine.dtype, mine.ndim, mine.shape[1:]) == (its.dtype, its.ndim, its.shape[1:])


@given(wire=st.binary(max_size=200))
def test_random_bytes_are_rejected(wire: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode(wire, SAMPLES[0])


@pytest.mark.parametrize(
    ("wire", "nothing", "why"),
    [
        (b"\x00" * (MAX_PAYLOAD_BYTES + 1), 0, "exceed the largest message"),
        (encode(3), True, "a bool was expected, not a int"),
        (encode([1, 2]), InitialMatches(), "not a InitialMatches: 1 fields were expected"),
        (encode([[1, 2]]), InitialMatches(), "InitialMatches.reports: a MovingMatches was expected, not a int"),
        (encode(random_array(3, 2)), np.zeros((0, 3)), r"the array must be \(n, 3\), got shape \(3, 2\)"),
        (encode(random_array(3)), np.zeros((0, 3)), r"the array must be \(n, 3\), got shape \(3,\)"),
        (encode(np.arange(3)), np.zeros(0), "an array of float64 was expected, not of int64"),
        (encode((1, 2, 3)), (0, 0.0), "2 values were expected, not 3"),
        (encode(SAMPLES[1]), SAMPLES[0], "not a TermsMessage: 3 fields were expected"),
        (b"\x91" * 5000, 0, "not a message"),
        (
            encode(TermsMessage(random_array(26), 1.0, 1.0)),
            SAMPLES[0],
            r"TermsMessage.upper must be \(27,\), got shape",
        ),
        (
            encode(RelocalizationMatches(random_array(3, 3), random_array(4, 2))),
            RelocalizationMatches(),
            r"RelocalizationMatches.pixels must be \(3, 2\), got shape \(4, 2\)",
        ),
    ],
)
def test_invalid_messages_are_rejected(wire: bytes, nothing: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        decode(wire, nothing)


def test_nested_records_are_validated() -> None:
    wire = msgspec.msgpack.encode([[1.0, 2.0, 3, 4, 5.0], encode_array(random_array(2))])
    with pytest.raises(ValueError, match=r"KnownDepthMatches\.observations: not a LandmarkMatches: 8 fields"):
        decode(wire, KnownDepthMatches())


@pytest.mark.parametrize("wire", [msgspec.msgpack.Ext(0, bytes(4)), ["<f8", [3], None, True], 1, b""])
def test_references_and_uncompressed_arrays_are_rejected(wire: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode(msgspec.msgpack.encode([wire, 1.0, 1.0]), SAMPLES[0])


@pytest.mark.parametrize("value", [random_array(2, 2, 2), {1}, np.zeros(3, complex), object()])
def test_unsupported_types_are_rejected(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be serialized"):
        encode(value)


@pytest.mark.parametrize(
    ("value", "most"),
    [
        (np.round(random_array(100, 2) * 0.2 * 2**16) / 2**16, 2.2),  # image points on their grid: 17 bits each
        (np.sort(RNG.integers(0, 600, 100)), 0.8),  # sorted numbers, by their differences
        (RNG.integers(-(2**40), 2**40, 9), 8.0),
        (np.full(50, 2**62), 8.0),
        (random_array(100).astype(np.float32).astype(float), 4.0),
        (np.array([np.nan, np.inf, 0.5, 1e300]), 8.0),
        (random_array(20, 3), 8.0),
        (np.array([-7]), 8.0),
        (np.zeros((0, 3)), 0.0),
    ],
)
def test_arrays_are_lossless_and_compact(value: Any, most: float) -> None:
    wire = encode_array(value)
    assert_same(decode_array(wire), value)
    assert len(wire) <= most * value.size + 7 + 17 * (value.ndim if most < 4 else 0)


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"\x00",
        b"\x38\x00" + b"\x01\x00\x00\x00" + b"\x01" + b"\x00" * 17,  # multiplied by too large a power of two
        b"\x04\x00" + b"\xff\xff\xff\xff" + b"\x01" + b"\x00" * 16,  # more rows than the bytes contain
        b"\x04\x00" + b"\x02\x00\x00\x00" + b"\x00" * 17,  # numbers of zero bits
        b"\x05\x07" + b"\x01\x00\x00\x00" + b"\x01" + b"\x00" * 17,  # too many columns
        encode_array(np.arange(9)) + b"\x00",
        encode_array(random_array(4))[:-1],
    ],
)
def test_invalid_arrays_are_rejected(wire: bytes) -> None:
    with pytest.raises(ValueError, match="not an array"):
        decode_array(wire)
