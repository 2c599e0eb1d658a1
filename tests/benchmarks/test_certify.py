"""`benchmarks/certify.py`: certificates compared with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.certify import KINDS, compare_certificate, format_row
from sylpose.runs.certify import certify_results
from tests.runs.test_certify import FRAMES, NAMES, PAIRS, SDS, draw_errors, make_result


def test_ratios_to_the_truth() -> None:
    """Of independent cameras they are 1; without parts nothing is certified."""
    errors = dict(zip(NAMES, draw_errors(np.random.default_rng(0)), strict=True))
    complete = make_result(np.mean([*errors.values()], axis=0), SDS)
    parts = {
        part: make_result(np.mean([errors[name] for name in part], axis=0), np.sqrt(2) * SDS, part) for part in PAIRS
    }
    true = make_result(np.zeros((FRAMES, 6)), SDS)
    truth = RigidTransform.concatenate([pose for f in true if (pose := f.world_from_object) is not None])
    certificate = certify_results("object", complete, parts, "not run.")
    run = compare_certificate("kind", 3, complete, certificate, truth)
    for accuracy, sds in ((run.rotation, np.degrees(SDS[:3])), (run.position, 1e3 * SDS[3:])):
        assert accuracy is not None
        assert accuracy.true == pytest.approx(np.linalg.norm(sds) / 2, rel=0.1)
        assert accuracy.certified == pytest.approx(accuracy.true, rel=0.1)
        # The stated standard deviations are twice the errors.
        assert accuracy.true_factor == pytest.approx(0.5, rel=0.1)
        assert accuracy.factor == pytest.approx(0.5, rel=0.1)
    assert format_row("kind", [run]).startswith("| kind | 1, 1 | 0.16° | 0.96 (0.96 to 0.96) | 0 of 1, least 0.99 |")
    nothing = certify_results("object", complete, dict.fromkeys(PAIRS, "lost."), complete)
    run = compare_certificate("kind", 4, complete, nothing, truth)
    assert format_row("kind", [run]).startswith("| kind | 0, 1 | 0.16° | - | - | - |")


def test_kinds_of_errors_that_all_cameras_share_are_named() -> None:
    assert {name for name in KINDS if name.startswith("shared")} == {"shared-scale", "shared-focal"}
