"""A camera whose translation is in another unit than the others' is named; rigs of one unit are not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.io.calibration.unit_consistency import describe_unit_outlier
from sylpose.rig import Camera, Rig
from sylpose.simulate import ring


def scale_translation(camera: Camera, factor: float) -> Camera:
    pose = camera.camera_from_world
    return replace(camera, camera_from_world=RigidTransform.from_components(factor * pose.translation, pose.rotation))


def move_world(rig: Rig, origin: RigidTransform) -> Rig:
    return Rig([replace(camera, camera_from_world=camera.camera_from_world * origin) for camera in rig], rig.unit)


@pytest.mark.parametrize("factor", [1000.0, 100.0, 0.01, 0.001])
@pytest.mark.parametrize("in_first_camera", [False, True])
def test_camera_in_another_unit_is_named(factor: float, in_first_camera: bool) -> None:
    rig = move_world(ring(4), RigidTransform.from_translation([0.3, -0.2, 0.4]))
    if in_first_camera:
        rig = move_world(rig, rig.cameras[0].camera_from_world.inv())
    cameras = list(rig)
    cameras[2] = scale_translation(cameras[2], factor)
    text = describe_unit_outlier(Rig(cameras))
    assert text.startswith(f"{cameras[2].name}: its distance from the world's origin is about ")
    assert f"about {factor:g} times" in text or f"about 1/{1 / factor:g}" in text


def test_rigs_of_one_unit_have_no_outlier() -> None:
    rig = ring(4)
    first = rig.cameras[0].camera_from_world
    drifted = first.inv() * RigidTransform.from_translation([0.002, 0.001, -0.001])
    for other in (rig, move_world(rig, first.inv()), move_world(rig, drifted), Rig(rig.cameras[:2])):
        assert describe_unit_outlier(other) == ""
    assert describe_unit_outlier(Rig([scale_translation(camera, 1000.0) for camera in rig], "mm")) == ""
    # Twenty times as far is a telephoto lens.
    cameras = list(rig)
    cameras[1] = scale_translation(cameras[1], 20.0)
    assert describe_unit_outlier(Rig(cameras)) == ""


def test_two_of_four_are_ambiguous() -> None:
    cameras = [scale_translation(camera, 1000.0 if k % 2 else 1.0) for k, camera in enumerate(ring(4))]
    assert describe_unit_outlier(Rig(cameras)) == ""
