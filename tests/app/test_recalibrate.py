"""`sylpose track --refine-calibration`, as it is typed: what it says and writes; and who is taken for moved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose import calibration
from sylpose.adjustment.calibration import Correction
from sylpose.app.recalibrate import REFINED, changes
from sylpose.cli import main
from sylpose.simulate import render_sequence, ring


def test_as_typed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = render_sequence(tmp_path / "s", frames=8, turn_deg=24.0, size=(240, 180), n_cameras=3, boxes=True)
    assert main(["track", str(tmp_path / "s"), "--refine-calibration", "--no-overlay"]) == 0
    said = capsys.readouterr().out
    assert "Calibration   cam_0: " in said
    assert "cam_2: " in said
    refined = calibration.load(tmp_path / "s" / "sylpose" / REFINED)
    assert refined.names == truth.rig.names
    for a, b in zip(refined, truth.rig, strict=True):
        assert np.rad2deg((a.camera_from_world.rotation * b.camera_from_world.rotation.inv()).magnitude()) < 0.5
    assert (tmp_path / "s" / "sylpose" / "tracked.tum").exists()


def test_what_is_said() -> None:
    rig = ring(2)
    values, believed = np.zeros((2, 10)), np.tile([0.01] * 6 + [0.01, 5.0, 5.0, 0.02], (2, 1))
    sd = 0.1 * believed
    values[0, 0], values[0, 6] = 0.0087, 0.008
    sd[1, 3:6] = believed[1, 3:6]
    one, two = changes(Correction(rig, values, sd, believed), rig)
    assert one == "cam_0: turned by 0.50° (9 standard deviations), focal length +0.80 % (8 standard deviations)."
    assert two == "cam_1: nothing shown to be off; not told by this recording: place."
