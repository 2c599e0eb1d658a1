"""Certificates: the mathematics on synthetic results with known errors, and the files."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import open_session
from sylpose.results import FramePose, Trajectory
from sylpose.runs.certificate_page import CERTIFICATE_FILES, choose_ticks, render_certificate, write_certificate
from sylpose.runs.certify import (
    BarTest,
    Certificate,
    SessionCertificate,
    assess_agreement,
    bound_sphere,
    certify_results,
    choose_splits,
    count_effective,
    measure_bar,
    normalize_differences,
    part_ratios,
    pool_agreements,
    split_ratios,
)
from sylpose.simulate import arc
from sylpose.status import FrameStatus, Observability
from tests.saved import write_turn_recording

NAMES = ("cam_0", "cam_1", "cam_2", "cam_3")
# Standard deviations of one camera's errors: radians about, and meters along each axis.
SDS = np.array([0.004, 0.002, 0.003, 0.0004, 0.0008, 0.0006])
FRAMES = 250
PAIRS = sorted({part for split in choose_splits(NAMES) for part in split})


def make_result(
    errors: FloatArray,
    sds: FloatArray,
    names: tuple[str, ...] = NAMES,
    *,
    lost: Callable[[int], bool] = lambda _: False,
    observability: Observability = Observability.ALL,
) -> Trajectory:
    """Return a result with errors (n, 6) of (w, d) of frames 1 to n, and standard deviations (6,) that it states."""
    errors, k = np.vstack([np.zeros(6), errors]), np.arange(len(errors) + 1)
    turns = Rotation.from_rotvec(errors[:, :3]) * Rotation.from_rotvec(0.01 * k[:, None] * [0.36, 0.8, 0.48])
    places = np.column_stack([0.001 * k, 0.02 * np.sin(k / 9), np.ones(len(k))])
    poses = RigidTransform.from_components(places + errors[:, 3:], turns)
    values, covariance = (np.zeros(len(names), np.int64), np.full(len(names), np.nan)), np.diag(sds**2)
    frames = [FramePose(0, 0.0, FrameStatus.FIRST, poses[0], np.zeros((6, 6)), *values, observability)]
    for i in range(1, len(k)):
        status, pose = (FrameStatus.LOST, None) if lost(i) else (FrameStatus.TRACKED, poses[i])
        frames.append(FramePose(i, i / 30, status, pose, covariance, *values, observability))
    return Trajectory(frames, names, "m")


def draw_errors(rng: np.random.Generator, correlation: float = 0.0, cameras: int = 4) -> FloatArray:
    """Draw errors (cameras, n, 6), an autoregressive process in each."""
    noise = rng.normal(size=(cameras, FRAMES, 6))
    errors = noise.copy()
    for k in range(1, FRAMES):
        errors[:, k] = correlation * errors[:, k - 1] + math.sqrt(1 - correlation**2) * noise[:, k]
    return np.asarray(errors * SDS)


def certify(errors: FloatArray, ratio: float = 1.0, names: tuple[str, ...] = NAMES) -> Certificate:
    """Certify results that are means over cameras, whose stated standard deviations are wrong by a ratio."""
    rows = dict(zip(names, errors, strict=True))

    def result(cameras: tuple[str, ...]) -> Trajectory:
        return make_result(np.mean([rows[c] for c in cameras], axis=0), ratio * SDS / math.sqrt(len(cameras)), cameras)

    parts: Mapping[tuple[str, ...], Trajectory] = {
        part: result(part) for split in choose_splits(names) for part in split
    }
    return certify_results("object", result(names), parts, result(names))


def true_rms(errors: FloatArray) -> tuple[float, float]:
    squares = np.mean(errors, axis=0) ** 2
    return float(np.sqrt(squares[:, :3].sum(axis=1).mean())), float(np.sqrt(squares[:, 3:].sum(axis=1).mean()))


@pytest.mark.parametrize("ratio", [0.25, 1.0, 3.0])
@pytest.mark.parametrize("cameras", [3, 4, 5])
def test_known_errors_give_the_known_error_and_factor(ratio: float, cameras: int) -> None:
    errors = draw_errors(np.random.default_rng(cameras), cameras=cameras)
    names = tuple(f"cam_{c}" for c in range(cameras))
    certificate = certify(errors, ratio, names)
    for estimate, true in zip((certificate.rotation, certificate.position), true_rms(errors), strict=True):
        assert estimate is not None
        assert not estimate.is_lower_bound
        assert estimate.error == pytest.approx(true, rel=0.1)
        assert true < 1.05 * estimate.bound
        assert estimate.factor == pytest.approx(1 / ratio, rel=0.1)
        low, high = estimate.factor_interval
        assert low < estimate.factor < high < 1.2 * low
    splits = [test for test in certificate.tests if test.kind == "split"]
    for test in splits:
        assert test.rotation is not None
        assert test.rotation.factor == pytest.approx(1 / ratio, rel=0.15)
        assert test.rotation.in_bounds == pytest.approx({0.25: 0.05, 1.0: 0.95, 3.0: 1.0}[ratio], abs=0.05)


def test_correlated_errors_have_fewer_effective_samples_and_a_wider_interval() -> None:
    white, slow = (certify(draw_errors(np.random.default_rng(1), r)).rotation for r in (0.0, 0.9))
    assert white is not None
    assert slow is not None
    # (1 + r²) / (1 - r²) = 9.5 times fewer.
    assert 6 < white.n_effective / slow.n_effective < 14
    assert slow.bound / slow.error - 1 > 2 * (white.bound / white.error - 1) > 0
    assert np.ptp(np.log(slow.factor_interval)) > 2 * np.ptp(np.log(white.factor_interval))


def test_effective_samples_of_known_series() -> None:
    rng = np.random.default_rng(2)
    n_white, freedom = count_effective(rng.normal(size=(3000, 3)))
    assert 2700 < n_white <= 3000
    assert freedom == pytest.approx(3 * n_white, rel=0.02)
    along_one_axis = np.outer(rng.normal(size=3000), [0.6, 0.0, 0.8])
    assert count_effective(along_one_axis)[1] == pytest.approx(count_effective(along_one_axis)[0])
    assert count_effective(np.tile([1.0, 2.0, 3.0], (50, 1))) == pytest.approx((1.5, 1.5), rel=0.01)
    assert count_effective(np.zeros((5, 3))) == (5.0, 15.0)


def test_intervals_contain_the_truth_as_often_as_stated() -> None:
    covered = []
    for seed in range(200):
        errors = draw_errors(np.random.default_rng([seed, 3]), 0.8, 3)[:, :60, :3]
        covariance = np.tile(np.diag(SDS[:3] ** 2), (60, 1, 1))
        estimate = pool_agreements([assess_agreement(row, covariance, 1.0, 1.0) for row in errors], 1.0, "parts")
        low, high = estimate.factor_interval
        covered.append([low < 1.0 < high, float(np.linalg.norm(SDS[:3])) < estimate.bound])
    assert np.mean(covered, axis=0) == pytest.approx([0.95, 0.95], abs=0.04)


def test_an_error_that_all_cameras_share_is_not_seen() -> None:
    shared = np.broadcast_to(draw_errors(np.random.default_rng(4), 0.5, 1), (4, FRAMES, 6))
    certificate = certify(shared)
    assert certificate.rotation is not None
    assert certificate.rotation.error < 1e-6 * true_rms(shared)[0]


def test_equivariance_to_the_world_frame() -> None:
    errors = draw_errors(np.random.default_rng(5), 0.7)[:, :50]
    world = RigidTransform.from_components([3.0, -2.0, 0.5], Rotation.from_rotvec([0.5, -1.1, 0.7]))
    turn = np.kron(np.eye(2), world.rotation.as_matrix())

    def moved(result: Trajectory) -> Trajectory:
        frames = [
            FramePose(
                f.index,
                f.time,
                f.status,
                None if f.world_from_object is None else world * f.world_from_object,
                turn @ f.covariance @ turn.T,
                f.inliers,
                f.residuals,
            )
            for f in result
        ]
        return Trajectory(frames, result.camera_names, result.unit)

    results = {part: make_result(errors[NAMES.index(part[0])], SDS * [1, 2, 3, 4, 5, 6], part) for part in PAIRS}
    complete, back = make_result(errors[0] / 2, SDS), make_result(errors[1] / 3, SDS)
    one = certify_results("o", complete, results, back)
    other = certify_results("o", moved(complete), {part: moved(r) for part, r in results.items()}, moved(back))
    assert_close(one, other)


def assert_close(a: object, b: object) -> None:
    """Compare records, without what is in world axes."""
    if is_dataclass(a):
        for field in fields(a):
            if field.name != "differences":
                assert_close(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert isinstance(b, tuple)
        for x, y in zip(a, b, strict=True):
            assert_close(x, y)
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-6, nan_ok=True)
    else:
        assert a == b


def test_a_part_that_lost_the_object_gives_no_number() -> None:
    errors = draw_errors(np.random.default_rng(6))[:, :40]
    good = {part: make_result(errors[0], SDS, part) for part in PAIRS}
    lost = {part: make_result(0 * errors[0], SDS, part, lost=lambda k: k > 3) for part in PAIRS}
    complete = make_result(np.mean(errors, axis=0), SDS / 2)
    one_lost = certify_results("o", complete, {**good, PAIRS[0]: lost[PAIRS[0]]}, complete)
    assert any("cam_0, cam_1 found the object in 4 of 41 frames." in text for text in one_lost.remarks)
    failed = [test for test in one_lost.tests if test.a == "cam_0, cam_1" and test.kind == "part"]
    assert [(t.rotation, t.differences) for t in failed] == [(None, None)]
    assert one_lost.rotation is not None
    assert not one_lost.rotation.is_lower_bound
    all_lost = certify_results("o", complete, lost, complete)
    assert all_lost.rotation is not None
    assert all_lost.rotation.is_lower_bound
    assert len(all_lost.remarks) == len(PAIRS)
    nothing = certify_results("o", complete, dict.fromkeys(PAIRS, "no box."), "lost.")
    assert nothing.rotation is nothing.position is None


def test_a_part_with_some_lost_frames_states_its_coverage() -> None:
    errors = draw_errors(np.random.default_rng(7))[:, :40]
    parts = {part: make_result(errors[0], SDS, part, lost=lambda k: 10 <= k < 20) for part in PAIRS}
    certificate = certify_results("o", make_result(errors[1], SDS), parts, "not run.")
    assert {test.coverage for test in certificate.tests if test.kind == "part"} == {0.75}
    assert "cam_0, cam_1 found the object in 31 of 41 frames." in certificate.remarks[0]


def test_a_part_that_followed_something_else_is_named() -> None:
    errors = draw_errors(np.random.default_rng(12))[:, :40]
    parts = {part: make_result(errors[0], SDS, part) for part in PAIRS}
    complete = make_result(errors[1], SDS)
    assert not certify_results("o", complete, parts, complete).remarks
    parts[PAIRS[2]] = make_result(np.full((40, 6), [0.2, 0, 0, 0, 0, 0]), SDS, PAIRS[2])
    certificate = certify_results("o", complete, parts, complete)
    (remark,) = certificate.remarks
    assert remark.startswith("cam_0, cam_3 alone makes most of the error of rotation: 11°, the other parts 0.4")
    # The number is not changed: which of the results is wrong is not known.
    assert certificate.rotation is not None
    assert certificate.rotation.error == pytest.approx(0.2 / math.sqrt(6), rel=0.1)


def test_single_cameras_determine_rotation_only() -> None:
    names, errors = NAMES[:2], draw_errors(np.random.default_rng(8))[:2, :60]
    parts: dict[tuple[str, ...], Trajectory] = {
        (name,): make_result(row, SDS, (name,), observability=Observability.NO_SCALE)
        for name, row in zip(names, errors, strict=True)
    }
    complete = make_result(np.mean(errors, axis=0), SDS / math.sqrt(2), names)
    certificate = certify_results("o", complete, parts, make_result(errors[0], SDS, names))
    assert certificate.rotation is not None
    assert not certificate.rotation.is_lower_bound
    assert certificate.position is not None
    assert certificate.position.is_lower_bound
    assert any("a single camera has no scale" in text for text in certificate.remarks)


def test_one_camera_is_compared_backwards_only() -> None:
    result = make_result(draw_errors(np.random.default_rng(9))[0], SDS, NAMES[:1])
    certificate = certify_results("o", result, {}, result)
    assert certificate.rotation is not None
    assert certificate.rotation.is_lower_bound
    assert certificate.rotation.error == 0


@pytest.mark.parametrize("n", range(1, 11))
def test_splits(n: int) -> None:
    names = [f"cam_{c}" for c in range(n)]
    splits = choose_splits(names)
    assert len(splits) == (min(n - 1, 1) if n < 3 else 3) == len(set(splits))
    for a, b in splits:
        if n == 3:
            assert len(a) == len(b) == 2
        else:
            assert sorted(a + b) == sorted(names)
            assert abs(len(a) - len(b)) <= 2
        assert set(a) | set(b) == set(names)


def test_ratios_of_independent_cameras() -> None:
    """By simulation: results are means over cameras of unit variance."""
    rng = np.random.default_rng(10)
    for n in (2, 3, 4, 5, 7):
        names, values = [str(c) for c in range(n)], rng.normal(size=(n, 20_000))
        for a, b in choose_splits(names):
            mean_a, mean_b = (values[[int(c) for c in part]].mean(axis=0) for part in (a, b))
            error, variance = split_ratios(n, a, b)
            assert error * (mean_a - mean_b).std() == pytest.approx(n**-0.5, rel=0.03)
            assert (mean_a - mean_b).var() == pytest.approx(variance * (1 / len(a) + 1 / len(b)), rel=0.05)
            error, variance = part_ratios(n, len(a))
            assert error * (mean_a - values.mean(axis=0)).std() == pytest.approx(n**-0.5, rel=0.03)
            assert (mean_a - values.mean(axis=0)).var() == pytest.approx(variance / n, rel=0.05)


def test_frames_without_a_finite_covariance_are_left_out() -> None:
    covariance = np.tile(np.eye(3), (4, 1, 1))
    covariance[1, 0, 0], covariance[2] = np.inf, 0.0
    assert normalize_differences(np.ones((4, 3)), covariance) == pytest.approx(np.ones((2, 3)))


# --- bar ------------------------------------------------------------------------------------------------------------------


def make_bar(errors: FloatArray) -> BarTest:
    rest = RigidTransform.from_components([0.3, 0.1, 0.0], Rotation.from_rotvec([0.2, 0.3, 0.1]))
    left = make_result(np.zeros((40, 6)), SDS)
    frames = [
        FramePose(
            f.index,
            f.time,
            f.status,
            f.world_from_object * RigidTransform.from_components([x, 0, 0], Rotation.from_rotvec([0, 0, turn])) * rest,
            f.covariance,
            f.inliers,
            f.residuals,
        )
        for f, (x, turn) in zip(left, errors, strict=True)
        if f.world_from_object is not None
    ]
    return measure_bar(("left", "right"), left, Trajectory(frames, NAMES, "m"))


def test_a_constant_relative_pose_gives_zero() -> None:
    bar = make_bar(np.zeros((41, 2)))
    assert bar.length == pytest.approx(math.hypot(0.3, 0.1))
    assert [*bar.length_statistics] == [*bar.rotation_statistics] == ["rms", "max", "p99.7"]
    assert max(*bar.length_statistics.values(), *bar.rotation_statistics.values()) < 1e-7
    assert bar.turn == pytest.approx(0.4)
    assert bar.coverage == 1


def test_known_deviations_of_the_bar() -> None:
    signs = np.tile([1.0, -1.0], 21)[:40]
    bar = make_bar(np.vstack([np.zeros(2), np.column_stack([0.001 * signs, 0.002 * signs])]))
    assert bar.rotation_statistics["rms"] == pytest.approx(0.002, rel=0.03)
    # The error is along the first object's x axis, most of which is along the bar.
    assert bar.length_statistics["max"] == pytest.approx(0.001 * 0.3 / math.hypot(0.3, 0.1), rel=0.01)
    assert bar.length_statistics["max"] >= bar.length_statistics["p99.7"] >= bar.length_statistics["rms"]


def test_a_bar_needs_common_frames() -> None:
    left = make_result(np.zeros((9, 6)), SDS, lost=lambda k: k > 4)
    right = make_result(np.zeros((9, 6)), SDS, lost=lambda k: 1 <= k < 4)
    with pytest.raises(ValueError, match="bar: left and right have poses in 2 common frames; 3 are needed"):
        measure_bar(("left", "right"), left, right)


def test_boxes_contain_the_sphere() -> None:
    rig = arc(3, 40, 1.2, 500, (640, 480))
    center = np.array([0.05, 0.02, 0.0])
    for camera in rig:
        box = bound_sphere(rig, center, 0.1)[camera.name]
        middle = camera.project(center[None])[0]
        assert np.abs([box.x + box.width / 2, box.y + box.height / 2] - middle).max() < 3
        radius = camera.focal * 0.1 / np.linalg.norm(camera.center - center)
        assert [box.width, box.height] == pytest.approx([2 * radius] * 2, rel=0.05)
    behind = rig.cameras[0].center - rig.cameras[0].direction
    assert rig.cameras[0].name not in bound_sphere(rig, behind, 0.1)


# --- files ----------------------------------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """Collects the elements that are open, and all names."""

    def __init__(self) -> None:
        super().__init__()
        self.open, self.names = list[str](), set[str]()

    def handle_starttag(self, tag: str, attrs: object) -> None:  # noqa: ARG002
        self.names.add(tag)
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None:  # noqa: ARG002
        self.names.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def make_certificates() -> SessionCertificate:
    errors = draw_errors(np.random.default_rng(11))[:, :20]
    first = certify(errors)
    second = certify_results("<b>", make_result(errors[0], SDS), dict.fromkeys(PAIRS, "no box."), "lost.")
    return SessionCertificate((first, second), make_bar(np.zeros((41, 2))), ("a file & more",))


def test_page_is_well_formed_and_escapes_texts() -> None:
    facts = {"recording": "<script>", "created": "2026-01-01T10:00+00:00", "sylpose": "1", "calibration": "abc"}
    page = render_certificate(make_certificates(), facts)
    tags = Tags()
    tags.feed(page)
    assert not tags.open
    assert "script" not in tags.names
    assert "nan" not in page.lower().replace("nanum", "")
    assert "not certified" in page
    assert "cannot see" in page
    alone = SessionCertificate(make_certificates().objects[1:], None, ())
    assert "Its accuracy could not be certified." in render_certificate(alone, facts)


def test_files_have_all_numbers(tmp_path: Path) -> None:
    session = open_session(write_turn_recording(tmp_path / "recording", 2))
    certificates = make_certificates()
    files = write_certificate(certificates, session, tmp_path / "out")
    assert [file.name for file in files] == [*CERTIFICATE_FILES]
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == sorted(CERTIFICATE_FILES)
    content = json.loads(files[1].read_text(encoding="utf-8"), parse_constant=pytest.fail)
    rotation = certificates.objects[0].rotation
    assert rotation is not None
    assert content["objects"][0]["rotation_deg"]["error"] == pytest.approx(math.degrees(rotation.error))
    assert content["objects"][1]["rotation_deg"] is None
    assert content["bar"]["objects"] == ["left", "right"]
    rows = list(csv.DictReader(files[2].read_text(encoding="utf-8").splitlines()))
    test = certificates.objects[0].tests[0]
    assert test.differences is not None
    mine = [row for row in rows if (row["test"], row["a"]) == (test.kind, test.a)]
    written = [[float(row[f"w{axis}_deg"]) for axis in "xyz"] for row in mine]
    assert written == pytest.approx(np.degrees(test.differences.rotation), rel=1e-5)


def test_ticks_are_round() -> None:
    assert choose_ticks(0.0, 0.23) == pytest.approx([0, 0.05, 0.1, 0.15, 0.2])
    assert choose_ticks(10.2, 12.9) == pytest.approx([11, 12])
    assert choose_ticks(1.0, 1.0) == [1.0]
