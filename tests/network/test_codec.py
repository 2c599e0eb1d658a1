"""What is sent arrives to the bit, and nothing else gets in."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.landmarks.alignment import Sights
from sylpose.landmarks.messages import Judges, Says
from sylpose.network.arrays import array_packed, array_unpacked
from sylpose.network.codec import LARGEST, RECORDS, packed, unpacked
from sylpose.network.frame_announcement import Roll
from sylpose.network.wire_format import HEADER
from sylpose.relative_pose.terms import TermData
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.joint_state import Joint, Nudge
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import (
    Ages,
    Agreed,
    Chance,
    Following,
    Known,
    Middle,
    Moved,
    Recognised,
    Seen,
    Sighted,
    Stance,
)
from sylpose.tracking.state_transfer import Handover, Waited

RNG = np.random.default_rng(0)


def some(*shape: int) -> FloatArray:
    return RNG.standard_normal(shape)


def whole(n: int) -> Any:
    return RNG.integers(0, 1000, n)


POSE = RigidTransform.from_components([0.1, -2.0, 3.0], Rotation.from_rotvec([0.3, 0.2, -0.1]))
TERM = TermData(2, some(7, 2), some(7, 2), np.eye(3), some(3), 812.5, POSE)
SIGHTS = Sights(some(5, 3), some(5, 3), some(5, 2), whole(5), some(5), np.eye(3), some(3), 700.0)
AGES = Ages(some(4), some(4), 3, 12, np.nan)
MODEL = ObjectModel(some(3), 0.3, some(9, 3), True, False)
SOLVED = SolvedFrame(7, 0.25, some(3), POSE, some(6, 6), some(3, 3), np.array([True, False, True]), 2.5)
VELOCITY = Velocity(some(6), some(6), 4, 0.03)
NUDGE = Nudge(1, 5, some(3), 0.01)
JOINT = Joint(MODEL, SOLVED, (SOLVED, SOLVED), Anchor(SOLVED, 3, True), (SOLVED,), VELOCITY, nudges=(NUDGE,), renewal=6)
JOINT = replace(JOINT, together=SOLVED)
WAITED = Waited(3, 0.1, np.array([0.1, np.nan, 0.1]), 2, some(3), POSE)
SAMPLES = [
    Says(some(27), 3.5, np.nan),
    Judges(1.5, 2.5, 17, 20, 12.5),
    Following(12, 30, True, False),
    Moved(TERM, some(7), 0.25, 9),
    Middle(4, np.nan, False, 3, 1.5),
    AGES,
    Chance(30, 20, 25, 1.25, 3),
    Known(SIGHTS, some(5)),
    Agreed(9, 12, (0, 3), (1.5, 2.0), AGES, 8, 7, 6, 0.5, True, 5, 4, 0.25, 10),
    Recognised(some(6, 3), some(6, 2)),
    Stance(True, some(3), 0.01, 17, True),
    Seen(whole(4), whole(4), some(4, 2), whole(2), some(2, 3)),
    TERM,
    SIGHTS,
    Sighted(whole(4), whole(4), some(4, 2), whole(2), some(2, 3), whole(2)),
    Handover(JOINT, (WAITED, WAITED), 8),
    WAITED,
    JOINT,
    MODEL,
    SOLVED,
    Anchor(SOLVED),
    VELOCITY,
    NUDGE,
    Roll(12, np.nan, (1, 3), False, True),
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


def test_each_record_has_a_sample() -> None:
    assert tuple(type(sample) for sample in SAMPLES) == RECORDS


@pytest.mark.parametrize("sample", SAMPLES, ids=[type(s).__name__ for s in SAMPLES])
def test_records_arrive_as_sent(sample: Any) -> None:
    assert_same(unpacked(packed(sample), sample), sample)
    assert_same(unpacked(packed([sample, sample]), []), [sample, sample])


@pytest.mark.parametrize("value", [0, 17, 2.5, np.nan, True, (3, 1.5), np.zeros((0, 3)), some(4, 3)])
def test_plain_values_arrive_as_sent(value: Any) -> None:
    assert_same(unpacked(packed(value), value), value)


def test_numbers_of_numpy_are_numbers() -> None:
    assert unpacked(packed(np.int64(3)), 0) == 3
    assert unpacked(packed(3), 0.0) == 3.0
    assert unpacked(packed((np.int64(1), np.float64(2))), (0, 0.0)) == (1, 2.0)


def test_a_round_of_the_alignment_fits_into_256_bytes() -> None:
    assert HEADER.size + len(packed(SAMPLES[0])) <= 256


@settings(max_examples=300)
@given(sample=st.sampled_from(SAMPLES), data=st.data())
def test_what_was_tampered_with_is_refused_or_is_a_record(sample: Any, data: st.DataObject) -> None:
    """Bytes changed, cut off or put in: whatever arrives has the types and shapes that it should have."""
    wire = bytearray(packed(sample))
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
        found = unpacked(bytes(wire), sample)
    except ValueError:
        return
    assert type(found) is type(sample)
    for field in fields(found):
        mine, its = getattr(found, field.name), getattr(sample, field.name)
        assert type(mine) is type(its) or mine is None or its is None
        if isinstance(mine, np.ndarray) and its is not None:
            assert (mine.dtype, mine.ndim, mine.shape[1:]) == (its.dtype, its.ndim, its.shape[1:])


@given(wire=st.binary(max_size=200))
def test_noise_is_refused(wire: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        unpacked(wire, SAMPLES[0])


@pytest.mark.parametrize(
    ("wire", "nothing", "why"),
    [
        (b"\x00" * (LARGEST + 1), 0, "more than any message"),
        (packed(3), True, "a bool was expected, not a int"),
        (packed([1, 2]), [], "a list of records was expected"),
        (packed(some(3, 2)), np.zeros((0, 3)), "an array of 3 columns was expected"),
        (packed(some(3)), np.zeros((0, 3)), "an array of 2 dimensions"),
        (packed((1, 2, 3)), (0, 0.0), "2 values were expected"),
        (packed(SAMPLES[1]), SAMPLES[0], "a Says was expected, not a Judges"),
        (b"\x91" * 5000, 0, "no message"),
        (packed(Says(some(26), 1.0, 1.0)), SAMPLES[1], r"no Says: upper has the shape \(26,\)"),
        (
            packed(Recognised(some(3, 3), some(4, 2))),
            Recognised.none(),
            r"no Recognised: pixels has the shape \(4, 2\)",
        ),
    ],
)
def test_bad_messages_are_named(wire: bytes, nothing: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        unpacked(wire, nothing)


def test_a_record_inside_a_record_is_checked() -> None:
    inner = msgspec.msgpack.Ext(RECORDS.index(Judges), msgspec.msgpack.encode([1.0, 2.0, 3, 4, 5.0]))
    weights = msgspec.msgpack.Ext(101, array_packed(some(2)))
    wire = msgspec.msgpack.encode(msgspec.msgpack.Ext(RECORDS.index(Known), msgspec.msgpack.encode([inner, weights])))
    with pytest.raises(ValueError, match="no Known: sights is a Judges"):
        unpacked(wire, Known.none())


@pytest.mark.parametrize("value", [some(2, 2, 2), "text", {"a": 1}, np.zeros(3, complex), object()])
def test_other_things_are_not_sent(value: Any) -> None:
    with pytest.raises(TypeError, match="is not sent"):
        packed(value)


@pytest.mark.parametrize(
    ("value", "most"),
    [
        (np.round(some(100, 2) * 0.2 * 2**16) / 2**16, 2.2),  # image points on their grid: 17 bits each
        (np.sort(RNG.integers(0, 600, 100)), 0.8),  # sorted numbers, by their differences
        (RNG.integers(-(2**40), 2**40, 9), 8.0),
        (np.full(50, 2**62), 8.0),
        (some(100).astype(np.float32).astype(float), 4.0),
        (np.array([np.nan, np.inf, 0.5, 1e300]), 8.0),
        (some(20, 3), 8.0),
        (np.array([-7]), 8.0),
        (np.zeros((0, 3)), 0.0),
    ],
)
def test_arrays_arrive_as_sent_in_few_bytes(value: Any, most: float) -> None:
    wire = array_packed(value)
    assert_same(array_unpacked(wire), value)
    assert len(wire) <= most * value.size + 7 + 17 * (value.ndim if most < 4 else 0)


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"\x00",
        b"\x38\x00" + b"\x01\x00\x00\x00" + b"\x01" + b"\x00" * 17,  # multiplied by too large a power of two
        b"\x04\x00" + b"\xff\xff\xff\xff" + b"\x01" + b"\x00" * 16,  # more rows than bytes tell
        b"\x04\x00" + b"\x02\x00\x00\x00" + b"\x00" * 17,  # numbers of no bits
        b"\x05\x07" + b"\x01\x00\x00\x00" + b"\x01" + b"\x00" * 17,  # too many columns
        array_packed(np.arange(9)) + b"\x00",
        array_packed(some(4))[:-1],
    ],
)
def test_what_is_no_array_is_refused(wire: bytes) -> None:
    with pytest.raises(ValueError, match="no array"):
        array_unpacked(wire)
